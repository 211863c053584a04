"""Numbers and texts as DDS writes them (CDR, OMG's Common Data Representation, version 1).

Behind four bytes that name the encoding, each number begins at a multiple of its size, counted from there. Every
middleware of ROS 2 sends messages in this way.
"""

from __future__ import annotations

import struct
from typing import Final

_BEGIN: Final = 4
_LITTLE_ENDIAN = b"\0\1\0\0"


class CdrWriter:
    """Puts a message together."""

    def __init__(self) -> None:
        self._data = bytearray(_LITTLE_ENDIAN)

    def numbers(self, kinds: str, *values: float) -> None:
        """Write numbers; ``kinds`` has a letter of the module struct for each, all of the same size."""
        self._align(struct.calcsize(f"={kinds[0]}"))
        self._data += struct.pack(f"<{kinds}", *values)

    def text(self, value: str) -> None:
        """Write a string."""
        data = value.encode()
        self.numbers("I", len(data) + 1)
        self._data += data + b"\0"

    def raw(self, alignment: int, data: bytes) -> None:
        """Write numbers of such a size that are bytes already."""
        self._align(alignment)
        self._data += data

    def message(self) -> bytes:
        """What was written."""
        return bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - _BEGIN) % size)


class CdrReader:
    """Walks along a message."""

    def __init__(self, data: bytes) -> None:
        """Raises:
        ValueError: it is not written in this way.
        """
        if len(data) < _BEGIN or data[0] != 0 or data[1] > 1:
            raise ValueError("the bytes are not those of a message in CDR")
        self.order: Final = "<" if data[1] == 1 else ">"
        """Of the bytes of a number, as struct and numpy name it."""
        self._data, self._number = data, struct.Struct(f"{self.order}I")
        self.at = _BEGIN
        """Where what was not read yet begins."""

    def number(self) -> int:
        """The next unsigned number of 32 bits.

        Raises:
            ValueError: the message ends before.
        """
        self.align(4)
        if self.at + 4 > len(self._data):
            raise ValueError("the message is too short")
        (value,) = self._number.unpack_from(self._data, self.at)
        self.at += 4
        return int(value)

    def skip(self, size: int, count: int = 1) -> None:
        """Pass over so many numbers of such a size."""
        self.align(size)
        self.at += size * count

    def skip_text(self) -> None:
        """Pass over a string.

        Raises:
            ValueError: the message ends before it.
        """
        self.skip(1, self.number())

    def align(self, size: int) -> None:
        """Go to where a number of this size can begin."""
        self.at += -(self.at - _BEGIN) % size
