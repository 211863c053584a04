"""MCAP bags of ROS 2 as serialized messages: what is in them, in the order in which it was recorded."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from regnet_core.errors import BagError
from regnet_core.io.mcap_files import bag_files, open_mcap

_DEFAULT_DEPTH = 10
_LATCHED_TOPICS = ("/tf_static",)


class BagTopic(NamedTuple):
    """One topic of a bag."""

    name: str
    type_name: str
    """Such as ``sensor_msgs/msg/PointCloud2``."""
    qos: QoSProfile
    """What the recorded publisher offered."""


class BagMessage(NamedTuple):
    """One serialized message."""

    topic: str
    time_ns: int
    """When it was recorded [ns]."""
    data: bytes
    """In CDR, as it went over the wire."""


class Bag:
    """A bag: a folder in rosbag2's layout, or one .mcap file."""

    def __init__(self, path: str | Path) -> None:
        """Look at the index of every file.

        Raises:
            BagError: the path is no readable bag.
        """
        self.path = Path(path)
        self._files = bag_files(self.path)
        self.topics: dict[str, BagTopic] = {}
        for file in self._files:
            with open_mcap(file) as reader:
                summary = reader.get_summary()
                if summary is None:
                    raise BagError("the file has no index: it was not closed; mend it with `mcap recover`")
                for channel in summary.channels.values():
                    schema = summary.schemas.get(channel.schema_id)
                    if schema is not None and channel.message_encoding == "cdr":
                        qos = recorded_qos(channel.topic, channel.metadata.get("offered_qos_profiles", ""))
                        self.topics[channel.topic] = BagTopic(channel.topic, schema.name, qos)

    def messages(self, topics: list[str]) -> Iterator[BagMessage]:
        """The messages on these topics in the order of their time.

        Raises:
            BagError: a file is damaged.
        """
        for file in self._files:
            with open_mcap(file) as reader:
                for _, channel, message in reader.iter_messages(topics):
                    yield BagMessage(channel.topic, message.log_time, message.data)


def message_class(type_name: str) -> Any:
    """The class of a message type such as ``sensor_msgs/msg/PointCloud2``; None where its package is not installed."""
    package, _, name = type_name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name, None)
    except (ImportError, ValueError):
        return None


def recorded_qos(topic: str, offered: str) -> QoSProfile:
    """The QoS that a publisher of the topic offered, from rosbag2's text: a YAML list of profiles.

    The policies are words in bags of Jazzy and numbers in older ones. With several publishers the first counts.
    """
    qos = QoSProfile(depth=_DEFAULT_DEPTH)
    if topic in _LATCHED_TOPICS:
        qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
    try:
        profile = yaml.safe_load(offered)[0]
        qos.reliability = _policy(ReliabilityPolicy, profile["reliability"])
        qos.durability = _policy(DurabilityPolicy, profile["durability"])
        qos.history = _policy(HistoryPolicy, profile["history"])
        qos.depth = max(int(profile["depth"]), 1)
        qos.lifespan = _duration(profile.get("lifespan", {}))
    except (yaml.YAMLError, LookupError, TypeError, ValueError):
        return qos
    return qos


def _policy(kind: Any, value: str | int) -> Any:
    policy = kind(value) if isinstance(value, int) else kind[value.upper()]
    if policy.name in ("SYSTEM_DEFAULT", "UNKNOWN", "BEST_AVAILABLE"):
        raise ValueError(f"a publisher cannot be made with {policy.name}")
    return policy


def _duration(value: dict[str, int]) -> Duration:
    """A lifespan; without limit where it was not set (rosbag2 writes the greatest number)."""
    seconds = int(value.get("sec", 0))
    return Duration(seconds=seconds, nanoseconds=int(value.get("nsec", 0))) if seconds < 10**9 else Duration()
