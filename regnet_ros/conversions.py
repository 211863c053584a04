"""Between messages and regnet_core: clouds, grippers, grasps, reports, poses."""

from __future__ import annotations

import array
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import Pose, PoseArray, PoseStamped
from regnet_msgs.msg import Grasp, GraspArray, SelectedGrasp
from regnet_msgs.msg import Gripper as GripperMessage
from regnet_msgs.msg import StepReport as StepMessage
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, matrix_from_quaternion, quaternion_from_matrix
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.io.pointcloud2 import DecodedCloud, decode_cloud, encode_cloud
from regnet_core.report import DetectionReport, StepReport

NUMBERS = 11
"""Of a Grasp: position, orientation, width, quality, vertical score, confidence; all are float64."""
_UNIT = 1e-3
"""How far a quaternion's length may be from 1."""


class GraspMessageError(InvalidInputError):
    """A GraspArray holds numbers that describe no grasp."""


def cloud_from_message(message: PointCloud2) -> DecodedCloud:
    """Coordinates (N, 3) and colours (N, 3) or None of a cloud in any valid layout, invalid points included.

    Raises:
        CloudError: the layout is not valid; the text says what is wrong and what would be right.
    """
    return decode_cloud(
        message.fields,
        message.width,
        message.height,
        message.point_step,
        message.row_step,
        message.is_bigendian,
        message.data,
    )


def cloud_to_message(header: Header, points: npt.ArrayLike, colors: npt.NDArray[np.uint8] | None = None) -> PointCloud2:
    """A dense, unorganised cloud of points (N, 3) [m] with float32 coordinates and packed ``rgb`` where given."""
    encoded = encode_cloud(points, colors)
    count = len(np.asarray(points))
    return PointCloud2(
        header=header,
        height=1,
        width=count,
        fields=[PointField(name=f.name, offset=f.offset, datatype=f.datatype, count=f.count) for f in encoded.fields],
        is_bigendian=False,
        point_step=encoded.point_step,
        row_step=encoded.point_step * count,
        data=array.array("B", encoded.data),
        is_dense=True,
    )


def gripper_from_message(message: GripperMessage) -> Gripper:
    """The gripper.

    Raises:
        GripperError: a dimension is out of its limits.
    """
    return Gripper(message.width, message.depth, message.height, message.thickness, message.palm_depth)


def gripper_to_message(gripper: Gripper) -> GripperMessage:
    """The message of a gripper."""
    return GripperMessage(
        width=gripper.width,
        depth=gripper.depth,
        height=gripper.height,
        thickness=gripper.thickness,
        palm_depth=gripper.palm_depth,
    )


def pose_to_message(matrix: Array) -> Pose:
    """A rigid transform (4, 4) as a pose."""
    return poses_to_messages(np.asarray(matrix)[None])[0]


def poses_to_messages(matrices: Array) -> list[Pose]:
    """Rigid transforms (M, 4, 4) as poses."""
    if len(matrices) == 0:
        return []
    messages = [Pose() for _ in range(len(matrices))]
    _fill_poses(messages, matrices)
    return messages


def _fill_poses(messages: list[Pose], matrices: Array) -> None:
    """Write transforms (M, 4, 4) into M poses: messages made of parts would make each of the parts twice."""
    quaternions = quaternion_from_matrix(matrices[:, :3, :3]).tolist()
    positions = matrices[:, :3, 3].tolist()
    for message, p, q in zip(messages, positions, quaternions, strict=True):
        position, orientation = message.position, message.orientation
        position.x, position.y, position.z = p
        orientation.x, orientation.y, orientation.z, orientation.w = q


def grasps_to_messages(grasps: Grasps) -> list[Grasp]:
    """One message for each grasp."""
    if len(grasps) == 0:
        return []
    messages = [Grasp() for _ in range(len(grasps))]
    _fill_poses([message.pose for message in messages], grasps.poses)
    numbers = np.column_stack([grasps.width, grasps.quality, grasps.vertical_score, grasps.confidence]).tolist()
    for message, row in zip(messages, numbers, strict=True):
        message.width, message.quality, message.vertical_score, message.confidence = row
    return messages


def grasps_from_messages(messages: Iterable[Grasp]) -> Grasps:
    """The batch of grasps, in the order of the messages.

    Raises:
        GraspMessageError: a number is not finite, or an orientation is no unit quaternion.
    """
    return grasps_of_numbers(numbers_of_grasps(messages))


def numbers_of_grasps(messages: Iterable[Grasp]) -> Array:
    """(M, 11): position, orientation, width, quality, vertical score, confidence, as the message has them."""
    rows = [
        (
            *(m.pose.position.x, m.pose.position.y, m.pose.position.z),
            *(m.pose.orientation.x, m.pose.orientation.y, m.pose.orientation.z, m.pose.orientation.w),
            *(m.width, m.quality, m.vertical_score, m.confidence),
        )
        for m in messages
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, NUMBERS)


def grasps_of_numbers(table: Array) -> Grasps:
    """The batch of grasps of such numbers (M, 11).

    Raises:
        GraspMessageError: a number is not finite, or an orientation is no unit quaternion.
    """
    if len(table) == 0:
        return Grasps.empty()
    broken = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if len(broken):
        raise GraspMessageError(f"grasp {broken[0]} of the array holds a number that is NaN or infinite")
    length = np.linalg.norm(table[:, 3:7], axis=1)
    bent = np.flatnonzero(np.abs(length - 1.0) > _UNIT)
    if len(bent):
        raise GraspMessageError(
            f"the orientation of grasp {bent[0]} must be a quaternion of length 1, its length is {length[bent[0]]:.4g}"
        )
    return Grasps(
        matrix_from_quaternion(table[:, 3:7]), table[:, :3], table[:, 7], table[:, 8], table[:, 9], table[:, 10]
    )


def steps_to_messages(steps: Iterable[StepReport]) -> list[StepMessage]:
    """One message for each step of a report."""
    return [StepMessage(name=s.name, kept=s.kept, rejected=s.rejected, seconds=s.seconds) for s in steps]


def report_from_message(message: GraspArray) -> DetectionReport:
    """The report of the detection that made the array."""
    steps = tuple(StepReport(s.name, s.kept, s.rejected, s.seconds) for s in message.steps)
    return DetectionReport(
        steps, message.model, message.device, message.reason, message.total_seconds, tuple(message.warnings)
    )


def grasp_array(header: Header, grasps: Grasps, gripper: Gripper, report: DetectionReport) -> GraspArray:
    """The message of a detection's result; ``header`` is that of the cloud."""
    return GraspArray(
        header=header,
        gripper=gripper_to_message(gripper),
        grasps=grasps_to_messages(grasps),
        steps=steps_to_messages(report.steps),
        model=report.model,
        device=report.device,
        reason=report.reason,
        warnings=list(report.warnings),
        total_seconds=report.total_seconds,
    )


def pose_array(header: Header, grasps: Grasps) -> PoseArray:
    """The grasp frames, best first."""
    return PoseArray(header=header, poses=poses_to_messages(grasps.poses))


def pose_stamped(selected: SelectedGrasp) -> PoseStamped:
    """The grasp frame of a selection alone."""
    return PoseStamped(header=selected.header, pose=selected.grasp)


def transform_matrix(transform: Any) -> Array:
    """A geometry_msgs/Transform as a matrix (4, 4)."""
    matrix = np.eye(4)
    q, t = transform.rotation, transform.translation
    matrix[:3, :3] = matrix_from_quaternion([q.x, q.y, q.z, q.w])
    matrix[:3, 3] = (t.x, t.y, t.z)
    return matrix
