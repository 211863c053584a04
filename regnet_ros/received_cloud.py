"""Clouds as a subscription receives them: their points stay where they are, in the bytes of the message.

rclpy copies a message twice before it calls anybody, into a structure of C and into one of Python. Of a cloud nearly
all is one array of bytes, which needs neither.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from regnet_core.errors import CloudError
from regnet_core.io.pointcloud2 import DecodedCloud, decode_cloud
from regnet_ros.cdr import CdrReader

_NO_BYTES = bytes(4)
"""The length of an array that has none; in either order of bytes."""
_STAMP_END = 12
"""What a message says of itself and its stamp are before that."""


class ReceivedCloud(NamedTuple):
    """A PointCloud2."""

    header: Header
    frame: PointCloud2
    """All of the message but its data, and its header."""
    data: memoryview
    """The points' bytes."""

    def decode(self) -> DecodedCloud:
        """Coordinates and colours, as ``cloud_from_message`` gives them; a view of the bytes where that can be.

        Raises:
            CloudError: the layout is not valid; the text says what is wrong and what would be right.
        """
        frame = self.frame
        return decode_cloud(
            frame.fields, frame.width, frame.height, frame.point_step, frame.row_step, frame.is_bigendian, self.data
        )


class CloudReader:
    """Reads serialized clouds; one after another of a camera differ in their stamps and points alone."""

    def __init__(self) -> None:
        self._last: _Layout | None = None

    def read(self, data: bytes) -> ReceivedCloud:
        """The cloud of a message as it is received.

        Raises:
            CloudError: it is none.
        """
        try:
            last = self._last
            if last is None or not last.fits(data):
                self._last = last = _Layout.of(data)
            if last is not None:
                return last.cloud(data)
            message = deserialize_message(data, PointCloud2)
        except Exception as error:  # of middleware and bindings, whatever they raise
            raise CloudError(f"a PointCloud2 of {len(data)} bytes cannot be read: {error}") from error
        return ReceivedCloud(message.header, message, memoryview(message.data))


class _Layout(NamedTuple):
    """What a message consists of."""

    order: str
    begin: int
    """Where the data begins."""
    end: int
    frame: PointCloud2
    """The message without data."""
    start: bytes
    """All before the stamp."""
    before: bytes
    """All between the stamp and the data."""
    after: bytes
    """All behind the data."""

    @classmethod
    def of(cls, data: bytes) -> _Layout | None:
        """None where it is written in another way."""
        place = _data_in(data)
        if place is None:
            return None
        begin, end = place
        frame = deserialize_message(data[: begin - 4] + _NO_BYTES + data[end:], PointCloud2)
        order = "<" if data[1] == 1 else ">"
        return cls(order, begin, end, frame, data[:4], data[_STAMP_END:begin], data[end:])

    def fits(self, data: bytes) -> bool:
        """Whether another message is the same but for its stamp and its points."""
        return (
            data[self.end :] == self.after and data[_STAMP_END : self.begin] == self.before and data[:4] == self.start
        )

    def cloud(self, data: bytes) -> ReceivedCloud:
        """The cloud of such a message."""
        header = Header(frame_id=self.frame.header.frame_id)
        header.stamp.sec, header.stamp.nanosec = struct.unpack_from(f"{self.order}iI", data, 4)
        return ReceivedCloud(header, self.frame, memoryview(data)[self.begin : self.end])


def _data_in(message: bytes) -> tuple[int, int] | None:
    """Where the data of a serialized PointCloud2 begins and ends; None where it is written in another way."""
    try:
        reader = CdrReader(message)
        reader.skip(4, 2)  # stamp
        reader.skip_text()  # frame_id
        reader.skip(4, 2)  # height, width
        for _ in range(reader.number()):
            reader.skip_text()  # name
            reader.skip(4)  # offset
            reader.skip(1)  # datatype
            reader.skip(4)  # count
        reader.skip(1)  # is_bigendian
        reader.skip(4, 2)  # point_step, row_step
        length = reader.number()
    except ValueError:
        return None
    end = reader.at + length
    # What follows is is_dense, then what fills the message up to a multiple of 4 bytes.
    return (reader.at, end) if end + 1 <= len(message) <= end + 1 + 3 else None
