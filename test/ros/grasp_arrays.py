"""Made-up GraspArray messages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from regnet_msgs.msg import GraspArray
from std_msgs.msg import Header

from regnet_core import DetectionReport, Grasps, Gripper
from regnet_core.coder import decode_orientation
from regnet_ros.conversions import grasp_array

QUALITY = (0.9, 0.8, 0.7, 0.6)
TILT = (60.0, 0.0, 10.0, 20.0)
"""Angle of each grasp's approach from straight down [degrees]; with QUALITY the heuristic order is 1, 2, 0, 3."""


def grasps() -> Grasps:
    """Four grasps in a row along x, 0.1 m apart."""
    theta = np.pi / 2 - np.radians(TILT)
    rotation = decode_orientation(np.tile([0.0, 1.0, 0.0], (4, 1)), theta)
    translation = np.column_stack([np.arange(4) * 0.1 + 0.3, np.zeros(4), np.full(4, 0.8)])
    return Grasps.from_poses(rotation, translation, np.full(4, 0.06), np.array(QUALITY))


def array(stamp: int = 1, frame: str = "world", batch: Grasps | None = None, reason: str = "") -> GraspArray:
    header = Header(stamp=Time(sec=stamp), frame_id=frame)
    report = DetectionReport((), "made-up", "cpu", reason)
    return grasp_array(header, grasps() if batch is None else batch, Gripper(), report)


@dataclass(frozen=True)
class OddArray:
    """An array that a careless selector would stumble over."""

    name: str
    change: Callable[[GraspArray], None]
    message: str
    """Regular expression of what the selector says."""


def _position(message: GraspArray) -> None:
    message.grasps[2].pose.position.x = float("nan")


def _infinite(message: GraspArray) -> None:
    message.grasps[0].pose.position.z = float("inf")


def _no_rotation(message: GraspArray) -> None:
    message.grasps[1].pose.orientation = Quaternion(x=0.0, y=0.0, z=0.0, w=0.0)


def _long_rotation(message: GraspArray) -> None:
    message.grasps[3].pose.orientation = Quaternion(x=0.0, y=0.0, z=1.0, w=1.0)


def _quality(message: GraspArray) -> None:
    message.grasps[0].quality = float("nan")


def _wide(message: GraspArray) -> None:
    message.grasps[0].width = 0.2


def _negative(message: GraspArray) -> None:
    message.grasps[0].width = -0.01


def _no_gripper(message: GraspArray) -> None:
    message.gripper.width = 0.0


def _odd_gripper(message: GraspArray) -> None:
    message.gripper.depth = float("nan")


def _no_frame(message: GraspArray) -> None:
    message.header.frame_id = ""


def _no_grasps(message: GraspArray) -> None:
    message.grasps = []
    message.reason = "the table is empty"


def _no_grasps_no_reason(message: GraspArray) -> None:
    message.grasps = []


ODD_ARRAYS = (
    OddArray("NaN position", _position, r"grasp 2 .* NaN or infinite"),
    OddArray("infinite position", _infinite, r"grasp 0 .* NaN or infinite"),
    OddArray("zero quaternion", _no_rotation, r"orientation of grasp 1 .* its length is 0"),
    OddArray("quaternion of length 1.4", _long_rotation, r"orientation of grasp 3 .* its length is 1\.414"),
    OddArray("NaN quality", _quality, r"grasp 0 .* NaN or infinite"),
    OddArray("wider than the gripper", _wide, r"opening of grasp 0 must be in \(0, 0\.08\].* got 0\.2"),
    OddArray("negative opening", _negative, r"opening of grasp 0 must be in \(0, 0\.08\].* got -0\.01"),
    OddArray("gripper without a width", _no_gripper, r"width must be in \[0\.03, 0\.16\] m, got 0"),
    OddArray("gripper with a NaN", _odd_gripper, r"depth must be a number"),
    OddArray("no frame", _no_frame, r"no frame_id"),
    OddArray("no grasps", _no_grasps, r"the table is empty"),
    OddArray("no grasps and no reason", _no_grasps_no_reason, r"gave no reason"),
)
