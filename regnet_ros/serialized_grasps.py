"""A GraspArray as a publisher sends it, without messages: hundreds, each made of six others, take long to make."""

from __future__ import annotations

from functools import cache

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from regnet_msgs.msg import GraspArray
from std_msgs.msg import Header

from regnet_core.geometry import quaternion_from_matrix
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.report import DetectionReport, StepReport
from regnet_ros.cdr import CdrWriter
from regnet_ros.conversions import grasp_array


def serialized_grasp_array(header: Header, grasps: Grasps, gripper: Gripper, report: DetectionReport) -> bytes:
    """The bytes of ``grasp_array``; ``header`` is that of the cloud.

    Where rclpy does not read them as they are meant, with another middleware or another definition of the message,
    rclpy writes them.
    """
    if _is_understood():
        return _written(header, grasps, gripper, report)
    return bytes(serialize_message(grasp_array(header, grasps, gripper, report)))


@cache
def _is_understood() -> bool:
    """Whether rclpy reads an example as it is meant."""
    header = Header(frame_id="frame")
    header.stamp.sec, header.stamp.nanosec = -2, 3
    upright, centres = np.eye(3)[None].repeat(2, axis=0), np.arange(6.0).reshape(2, 3)
    grasps = Grasps.from_poses(upright, centres, np.full(2, 0.05), np.ones(2))
    steps = (StepReport("a", 1, 2, 0.5), StepReport("step", 3, 4, 0.25))
    report = DetectionReport(steps, "model", "device", "reason", 1.5, ("one", "another"))
    try:
        read = deserialize_message(_written(header, grasps, Gripper(), report), GraspArray)
    except Exception:  # of middleware and bindings, whatever they raise
        return False
    return bool(read == grasp_array(header, grasps, Gripper(), report))


def _written(header: Header, grasps: Grasps, gripper: Gripper, report: DetectionReport) -> bytes:
    out = CdrWriter()
    out.numbers("iI", header.stamp.sec, header.stamp.nanosec)
    out.text(header.frame_id)
    out.numbers("ddddd", gripper.width, gripper.depth, gripper.height, gripper.thickness, gripper.palm_depth)
    out.numbers("I", len(grasps))
    if len(grasps) > 0:
        numbers = (grasps.width, grasps.quality, grasps.vertical_score, grasps.confidence)
        table = np.column_stack([grasps.translation, quaternion_from_matrix(grasps.rotation), *numbers])
        out.raw(8, table.astype("<f8").tobytes())
    out.numbers("I", len(report.steps))
    for step in report.steps:
        out.text(step.name)
        out.numbers("II", step.kept, step.rejected)
        out.numbers("d", step.seconds)
    out.text(report.model)
    out.text(report.device)
    out.text(report.reason)
    out.numbers("I", len(report.warnings))
    for warning in report.warnings:
        out.text(warning)
    out.numbers("d", report.total_seconds)
    return out.message()
