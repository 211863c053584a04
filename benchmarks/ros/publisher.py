"""The process that publishes clouds as a camera's driver does: ready serialised, and says when it did."""

from __future__ import annotations

import time
from itertools import islice
from typing import Any

import rclpy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from benchmarks.clouds import bag_topic, cloud_source, read_cloud
from benchmarks.messages import sent
from benchmarks.ros.stamps import with_stamp
from regnet_core.io.bags import is_bag
from regnet_ros.bag import Bag
from regnet_ros.conversions import cloud_to_message
from regnet_ros.inputs import OUTPUT_QOS


class PublisherTask:
    """Publishes one cloud again and again, each time with another stamp."""

    def __init__(self, cloud: str, topic: str) -> None:
        """Args:
        cloud: as ``read_cloud`` takes it; a bag's message keeps its layout.
        topic: to publish on.
        """
        self._message = _serialised(cloud)
        rclpy.init(args=[])
        self._node = rclpy.create_node("benchmark_publisher", start_parameter_services=False)
        self._publisher = self._node.create_publisher(PointCloud2, topic, OUTPUT_QOS)

    def facts(self) -> dict[str, Any]:
        """How large the message is."""
        return {"bytes": len(self._message)}

    def subscribers(self) -> dict[str, Any]:
        """How many there are."""
        return {"count": self._publisher.get_subscription_count()}

    def measure(self, number: int) -> dict[str, Any]:
        """Publish the cloud with a stamp made of a number; when that began, by the machine's monotonic clock [ns]."""
        message = with_stamp(self._message, number)
        began = time.monotonic_ns()
        self._publisher.publish(message)
        return {"sent": began}


def _serialised(text: str) -> bytes:
    source = cloud_source(text)
    if source.path is not None and is_bag(source.path):
        messages = Bag(source.path).messages([bag_topic(source.path)])
        for message in islice(messages, source.number, source.number + 1):
            return message.data
    given = read_cloud(text)
    return sent(cloud_to_message(Header(frame_id="camera"), given.points, given.colors))
