"""Between the action's goals and what the cell executes."""

from __future__ import annotations

from typing import Any

import numpy as np
from rclpy.time import Time
from regnet_msgs.msg import SelectedGrasp

from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, matrix_from_quaternion
from regnet_core.gripper import Gripper
from regnet_core.robots.goal import GraspGoal
from regnet_ros.conversions import gripper_from_message

_UNIT = 1e-3
"""How far a quaternion's length may be from 1."""
_SAME = 1e-4
"""Dimensions of grippers are the same up to this [m]."""


def goal_from_message(selected: SelectedGrasp, world_frame: str, gripper: Gripper) -> GraspGoal:
    """The goal of a selected grasp.

    Args:
        selected: what the selector sends.
        world_frame: that poses must be in.
        gripper: of the robot.

    Raises:
        InvalidInputError: it is in another frame or for another gripper, or a number in it makes no sense.
    """
    frame = selected.header.frame_id.lstrip("/")
    if frame != world_frame.lstrip("/"):
        raise InvalidInputError(f"the grasp is in the frame '{frame}', the cell's is '{world_frame}'")
    made_for = gripper_from_message(selected.gripper)
    for name in Gripper.LIMITS:
        own, other = getattr(gripper, name), getattr(made_for, name)
        if abs(own - other) > _SAME:
            raise InvalidInputError(f"the grasp is for a gripper with {name} {other:g} m, the robot's is {own:g} m")
    if not 0.0 < selected.opening <= gripper.width + 1e-9:
        raise InvalidInputError(f"the opening must be in (0, {gripper.width:g}] m, got {selected.opening:g}")
    return GraspGoal(
        pose_matrix("pre_grasp", selected.pre_grasp),
        pose_matrix("grasp", selected.grasp),
        pose_matrix("lift", selected.lift),
        float(selected.opening),
    )


def pose_matrix(name: str, pose: Any) -> Array:
    """A geometry_msgs/Pose as a matrix (4, 4).

    Raises:
        InvalidInputError: a number is not finite, or the orientation is no unit quaternion; the name says of what.
    """
    p, q = pose.position, pose.orientation
    numbers = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
    if not np.isfinite(numbers).all():
        raise InvalidInputError(f"the pose {name} holds a number that is NaN or infinite")
    if abs(np.linalg.norm(numbers[3:]) - 1.0) > _UNIT:
        raise InvalidInputError(f"the orientation of {name} must be a quaternion of length 1")
    matrix = np.eye(4)
    matrix[:3, :3] = matrix_from_quaternion(numbers[3:])
    matrix[:3, 3] = numbers[:3]
    return matrix


def seen_before(selected: SelectedGrasp, moment: Time) -> bool:
    """Whether the grasp was found in a cloud from before a moment; not where it has no stamp."""
    stamp = Time.from_msg(selected.header.stamp, clock_type=moment.clock_type)
    return 0 < stamp.nanoseconds < moment.nanoseconds
