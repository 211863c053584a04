"""The bag player: what it publishes, when, with which QoS, and what it says."""

from __future__ import annotations

import math
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live import REPOSITORY, Inbox, System, wait_for
from mcap.reader import make_reader
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, PointCloud2

from regnet_core.errors import BagError
from regnet_ros.bag import Bag, message_class, recorded_qos
from regnet_ros.replay import Options, parse, split_arguments

BAG = REPOSITORY / "bags" / "one_object"
TOPIC = "/camera/depth/points"
INFO = "/camera/depth/camera_info"
START = 1_700_000_000


def recorded(topic: str) -> list[bytes]:
    with (BAG / "one_object.mcap").open("rb") as stream:
        return [message.data for _, _, message in make_reader(stream).iter_messages([topic])]


class Arrivals:
    """Messages of a topic with the times of their arrival."""

    def __init__(self, system: System, kind: type, topic: str, qos: Any = None) -> None:
        self.times: list[float] = []
        self.inbox = Inbox()
        self._subscription = system.peer.node.create_subscription(kind, topic, self._on, qos or QoSProfile(depth=50))
        self._node = system.peer.node

    def _on(self, message: Any) -> None:
        self.times.append(time.monotonic())
        self.inbox.put(message)

    def close(self) -> None:
        self._node.destroy_subscription(self._subscription)


def test_the_messages_come_out_as_they_were_recorded(system: System) -> None:
    arrivals = Arrivals(system, PointCloud2, TOPIC)
    player = system.start("replay", str(BAG), "--wait-for-subscribers", "--topics", TOPIC, INFO)
    infos = system.peer.listen(CameraInfo, INFO)
    assert player.wait() == 0, player.output
    wait_for(lambda: len(arrivals.times) == 4 and len(infos.all()) == 4, "all messages")
    received = arrivals.inbox.all()
    assert [m.header.stamp.sec * 10 + m.header.stamp.nanosec // 10**8 - START * 10 for m in received] == [0, 5, 10, 15]
    assert received == [deserialize_message(data, PointCloud2) for data in recorded(TOPIC)]
    gaps = [later - earlier for earlier, later in zip(arrivals.times, arrivals.times[1:], strict=False)]
    assert sum(gaps) == pytest.approx(1.5, abs=0.4)
    assert "played 8 messages" in player.output
    arrivals.close()


def test_twice_as_fast_renamed_and_with_the_clock(system: System) -> None:
    arrivals = Arrivals(system, PointCloud2, "/elsewhere/points")
    clock = Arrivals(system, Clock, "/clock", QoSProfile(depth=100))
    options = ["--rate", "2.0", "--clock", "--topics", TOPIC, "--remap", f"{TOPIC}:=/elsewhere/points"]
    player = system.start("replay", str(BAG), "--wait-for-subscribers", "30", *options)
    assert player.wait() == 0, player.output
    wait_for(lambda: len(arrivals.times) == 4, "all messages")
    assert arrivals.times[-1] - arrivals.times[0] == pytest.approx(0.75, abs=0.3)
    times = [m.clock.sec + m.clock.nanosec / 1e9 - START for m in clock.inbox.all()]
    assert len(times) > 20
    assert times == sorted(times)
    assert times[-1] == pytest.approx(1.5, abs=0.2)
    first, last = clock.times[0], clock.times[-1]
    assert (times[-1] - times[0]) / (last - first) == pytest.approx(2.0, rel=0.2)
    arrivals.close()
    clock.close()


def test_as_fast_as_possible_loses_nothing(system: System) -> None:
    arrivals = Arrivals(system, PointCloud2, TOPIC)
    player = system.start("replay", str(BAG), "--wait-for-subscribers", "--rate", "max", "--topics", TOPIC)
    assert player.wait() == 0, player.output
    wait_for(lambda: len(arrivals.times) == 4, "all messages")
    assert arrivals.inbox.all() == [deserialize_message(data, PointCloud2) for data in recorded(TOPIC)]
    assert arrivals.times[-1] - arrivals.times[0] < 1.5, "less than from the first to the last when they were recorded"
    arrivals.close()


def test_a_loop_goes_on_until_a_signal(system: System) -> None:
    arrivals = Arrivals(system, PointCloud2, TOPIC)
    player = system.start("replay", str(BAG), "--wait-for-subscribers", "--loop", "--rate", "20", "--topics", TOPIC)
    wait_for(lambda: len(arrivals.times) >= 10, "the second and third round")
    stamps = [m.header.stamp.nanosec for m in arrivals.inbox.all()[:8]]
    assert stamps[:4] == stamps[4:]
    player.signal(signal.SIGTERM)
    assert player.wait() == 0, player.output
    assert "Traceback" not in player.output
    arrivals.close()


def test_a_bag_of_one_message_is_not_repeated_without_pause(system: System) -> None:
    arrivals = Arrivals(system, PointCloud2, TOPIC)
    bag = str(BAG.parent / "tilted_depth_only")
    player = system.start("replay", bag, "--wait-for-subscribers", "--loop", "--rate", "4", "--topics", TOPIC)
    wait_for(lambda: len(arrivals.times) >= 4, "the fourth round")
    gaps = np.diff(arrivals.times[:4])
    player.signal(signal.SIGINT)
    assert player.wait() == 0, player.output
    assert np.median(gaps) > 0.2  # a quarter of a second at this rate; the first cloud may have been late
    arrivals.close()


def test_subscribers_are_waited_for_without_being_asked(system: System) -> None:
    arrivals = Arrivals(system, PointCloud2, TOPIC)
    player = system.start("replay", str(BAG), "--rate", "max", "--topics", TOPIC)
    assert player.wait() == 0, player.output
    wait_for(lambda: len(arrivals.times) == 4, "all four clouds")
    arrivals.close()


def test_topics_of_packages_that_are_not_installed_are_named(system: System) -> None:
    player = system.start("replay", str(BAG), "--rate", "max")
    assert player.wait() == 0, player.output
    if message_class("tf2_msgs/msg/TFMessage") is None:
        assert "skipping /tf_static (tf2_msgs/msg/TFMessage): the package tf2_msgs is not installed" in player.output
    else:
        assert "played 9 messages" in player.output


def test_the_recorded_qos_is_offered(system: System) -> None:
    player = system.start("replay", str(BAG / "one_object.mcap"), "--loop")
    [info] = wait_for(lambda: system.peer.node.get_publishers_info_by_topic(TOPIC), "the publisher")
    assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert info.qos_profile.durability == DurabilityPolicy.VOLATILE
    player.signal(signal.SIGINT)
    assert player.wait() == 0, player.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["/no/such/bag"], "there is no bag '/no/such/bag'"),
        ([str(BAG), "--topics", "/nonsense"], "has no topic /nonsense; it has /camera/depth/camera_info"),
        ([str(BAG), "--rate", "0"], "must be a positive number or 'max', got '0'"),
        ([str(BAG), "--remap", "points"], "must look like /old:=/new, got 'points'"),
        ([str(REPOSITORY / "README.md")], "cannot be read as an MCAP file"),
        ([str(REPOSITORY / "config")], "holds no .mcap file"),
    ],
)
def test_what_cannot_be_played_ends_with_code_2_and_the_reason(
    system: System, arguments: list[str], message: str
) -> None:
    player = system.start("replay", *arguments)
    assert player.wait() == 2, player.output
    assert message in player.output.replace("\n", " ")
    assert "Traceback" not in player.output


def test_options() -> None:
    options = parse(["bag", "--rate", "max", "--topics", "/a", "/b", "--remap", "/a:=/c", "--wait-for-subscribers"])
    assert options == Options(Path("bag"), math.inf, topics=("/a", "/b"), remap=(("/a", "/c"),), patience=math.inf)
    own, ros = split_arguments(["bag", "--ros-args", "-r", "a:=b", "--", "--loop"])
    assert own == ["bag", "--loop"]
    assert ros == ["--ros-args", "-r", "a:=b", "--"]


def test_qos_texts_of_old_and_new_bags() -> None:
    new = "- {depth: 7, durability: transient_local, history: keep_last, reliability: best_effort}"
    old = "- {depth: 7, durability: 1, history: 1, reliability: 2}"
    for text in (new, old):
        qos = recorded_qos("/points", text)
        assert (qos.depth, qos.durability, qos.reliability) == (
            7,
            DurabilityPolicy.TRANSIENT_LOCAL,
            ReliabilityPolicy.BEST_EFFORT,
        )
    for text in ("", "nonsense", "- {depth: x}", "[", "- {reliability: unknown, durability: 1, history: 1, depth: 1}"):
        assert recorded_qos("/points", text).reliability == ReliabilityPolicy.RELIABLE
    assert recorded_qos("/tf_static", "").durability == DurabilityPolicy.TRANSIENT_LOCAL


def test_a_damaged_bag_is_reported_by_name(tmp_path: Path) -> None:
    whole = (BAG / "one_object.mcap").read_bytes()
    (tmp_path / "short.mcap").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BagError, match=r"short\.mcap"):
        Bag(tmp_path / "short.mcap")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [other.mcap]}")
    with pytest.raises(BagError, match=r"lacks other\.mcap"):
        Bag(tmp_path)
    (tmp_path / "metadata.yaml").write_text("[]")
    with pytest.raises(BagError, match="not a rosbag2 metadata file"):
        Bag(tmp_path)
