"""A GraspArray as who selects from it needs it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from rclpy.serialization import deserialize_message
from regnet_msgs.msg import Grasp, GraspArray, SelectedGrasp
from regnet_msgs.msg import Gripper as GripperMessage
from std_msgs.msg import Header

from regnet_core.approach import lift_poses, pre_grasp_poses
from regnet_core.geometry import Array
from regnet_core.grasps import Grasps
from regnet_core.policy import Selection
from regnet_ros.cdr import CdrReader
from regnet_ros.conversions import NUMBERS, GraspMessageError, grasps_of_numbers, numbers_of_grasps, poses_to_messages


class GraspList(NamedTuple):
    """Grasps as numbers, and a message of those that are asked for.

    Hundreds of messages, each made of six others, take rclpy a hundred times as long to make as these numbers.
    """

    header: Header
    gripper: GripperMessage
    reason: str
    numbers: Array
    """(M, 11): position, orientation, width, quality, vertical score, confidence."""

    @classmethod
    def of_message(cls, message: GraspArray) -> GraspList:
        """Of a message."""
        return cls(message.header, message.gripper, message.reason, numbers_of_grasps(message.grasps))

    @classmethod
    def of_serialized(cls, data: bytes) -> GraspList:
        """Of a message as it is received.

        Raises:
            GraspMessageError: it is none.
        """
        try:
            return cls._of_serialized(data)
        except Exception as error:  # of middleware and bindings, whatever they raise
            raise GraspMessageError(f"a GraspArray of {len(data)} bytes cannot be read: {error}") from error

    @classmethod
    def _of_serialized(cls, data: bytes) -> GraspList:
        layout = _Layout.of(data)
        if layout is not None and layout.number > 1:
            numbers = layout.numbers(data)
            one = cls.of_message(deserialize_message(layout.first(data), GraspArray))
            if np.array_equal(one.numbers, numbers[:1], equal_nan=True):
                return one._replace(numbers=numbers)
        return cls.of_message(deserialize_message(data, GraspArray))

    def grasps(self) -> Grasps:
        """All of them.

        Raises:
            GraspMessageError: a number is not finite, or an orientation is no unit quaternion.
        """
        return grasps_of_numbers(self.numbers)

    def message(self, rank: int) -> Grasp:
        """One of them."""
        message, row = Grasp(), self.numbers[rank].tolist()
        position, orientation = message.pose.position, message.pose.orientation
        position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w = row[:7]
        message.width, message.quality, message.vertical_score, message.confidence = row[7:]
        return message


class _Layout(NamedTuple):
    """Where the grasps are in a serialized GraspArray."""

    order: str
    """Of the bytes of a number, as numpy names it."""
    at: int
    """Where the number of grasps begins; they do so 8 bytes later."""
    number: int

    @classmethod
    def of(cls, data: bytes) -> _Layout | None:
        """None where it is written in another way."""
        try:
            reader = CdrReader(data)
            reader.skip(4, 2)  # stamp
            reader.skip_text()  # frame_id
            reader.skip(8, 5)  # gripper
            at, number = reader.at, reader.number()
        except ValueError:
            return None
        return cls(reader.order, at, number) if at + 8 + number * NUMBERS * 8 <= len(data) else None

    def numbers(self, data: bytes) -> Array:
        """(M, 11)."""
        flat = np.frombuffer(data, f"{self.order}f8", self.number * NUMBERS, self.at + 8)
        return flat.astype(np.float64).reshape(-1, NUMBERS)

    def first(self, data: bytes) -> bytes:
        """The same array with its first grasp alone."""
        number = np.array([1, 0], f"{self.order}u4").tobytes()
        begin, size = self.at + 8, NUMBERS * 8
        return data[: self.at] + number + data[begin : begin + size] + data[begin + self.number * size :]


def selected_grasp(
    source: GraspList, grasps: Grasps, selection: Selection, pre_grasp_distance: float, lift_height: float
) -> SelectedGrasp:
    """The message of a selection.

    Args:
        source: the array that was selected from.
        grasps: its grasps.
        selection: which one of them.
        pre_grasp_distance: how far before the grasp, against its approach axis, the straight approach begins [m].
        lift_height: how far straight up the grasp is lifted [m].
    """
    pose, selected = grasps[selection.rank].poses, source.message(selection.rank)
    return SelectedGrasp(
        header=source.header,
        pre_grasp=poses_to_messages(pre_grasp_poses(pose, pre_grasp_distance))[0],
        grasp=selected.pose,
        lift=poses_to_messages(lift_poses(pose, lift_height))[0],
        opening=float(grasps.width[selection.rank]),
        policy=selection.policy,
        score=selection.score,
        rank=selection.rank,
        selected=selected,
        gripper=source.gripper,
    )
