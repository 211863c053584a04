"""What the nodes do with messages around regnet_core, in one process, so that each part of it can be timed."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseArray
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from benchmarks.clouds import GivenCloud
from regnet_core.detector import Detection
from regnet_core.preprocessing import Preprocessed
from regnet_ros import conversions, serialized_grasps, visuals
from regnet_ros.received_cloud import CloudReader

_MAX_MARKERS = 50
"""The detector node's default."""


def sent(message: Any) -> bytes:
    """A message as a publisher hands it to DDS."""
    return bytes(serialize_message(message))


class MessagePath:
    """The way of one cloud through messages: into the preprocessor, on to the detector, and out of it."""

    def __init__(self, cloud: GivenCloud) -> None:
        """``cloud``: as the camera publishes it."""
        self._cloud = sent(conversions.cloud_to_message(Header(frame_id="camera"), cloud.points, cloud.colors))
        self._readers = CloudReader(), CloudReader()

    def run(self, prepared: Preprocessed, detection: Detection) -> PoseArray:
        """Everything but what regnet_core does: it gave ``prepared`` and ``detection``."""
        cloud = self._readers[0].read(self._cloud)
        cloud.decode()
        header = Header(stamp=cloud.header.stamp, frame_id="world")
        data = sent(conversions.cloud_to_message(header, prepared.points, prepared.colors))
        sent(visuals.plane_marker(header, detection.plane, prepared.points))
        self._readers[1].read(data).decode()
        serialized_grasps.serialized_grasp_array(header, detection.grasps, detection.gripper, detection.report)
        poses = conversions.pose_array(header, detection.grasps)
        sent(poses)
        sent(visuals.grasp_markers(header, detection.grasps, detection.gripper, _MAX_MARKERS))
        return poses
