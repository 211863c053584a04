"""The end-to-end benchmarks: stamps, diagnostics, rates, and two small measurements with real nodes."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("regnet_msgs")

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from benchmarks.errors import BenchmarkError
from benchmarks.ros.latency import BEFORE, LatencySettings, measure_latency, node_latencies
from benchmarks.ros.stamps import number_of, with_stamp
from benchmarks.ros.system import ros_environment
from benchmarks.ros.throughput import ThroughputSettings, measure_throughput, received_rate, replay_rate
from regnet_core.errors import InvalidInputError

BAG = Path(__file__).resolve().parents[2] / "bags" / "one_object"


def quiet(line: str) -> None:
    """For progress that nobody reads."""


def test_only_the_stamp_of_a_message_changes() -> None:
    message = PointCloud2(header=Header(frame_id="camera"), height=1, width=7, point_step=12)
    data = bytes(serialize_message(message))
    changed = deserialize_message(with_stamp(data, 42), PointCloud2)
    assert number_of(changed.header.stamp.sec) == 42
    changed.header.stamp = message.header.stamp
    assert changed == message


def test_stamps_of_messages_in_the_other_byte_order() -> None:
    data = bytes([0, 0, 0, 0]) + struct.pack(">iI", 7, 9) + b"rest"
    assert number_of(struct.unpack(">i", with_stamp(data, 5)[4:8])[0]) == 5
    assert with_stamp(data, 5)[12:] == b"rest"
    with pytest.raises(InvalidInputError, match="plain CDR"):
        with_stamp(b"\x07\x01" + data[2:], 5)


def test_latencies_are_read_from_diagnostics() -> None:
    status = [
        {
            "node": "detector",
            "time": 1.0,
            "values": {"latency convert [ms]": "1.5", "received": "3", "state": "active"},
        },
        {"node": "detector", "time": 2.0, "values": {"latency convert [ms]": "2.5", "received": "9"}},
        {"node": "preprocessor", "time": 1.0, "values": {"received": "10"}},
        {"node": "preprocessor", "time": 3.0, "values": {"received": "40"}},
    ]
    assert node_latencies(status) == {"detector convert": [0.0015, 0.0025]}
    assert received_rate(status) == 15.0
    with pytest.raises(BenchmarkError, match="published 1 diagnostics"):
        received_rate(status[:3])


def test_a_looping_bag_is_played_as_fast_as_clouds_are_offered() -> None:
    # Four clouds in 1.5 s, and at once from the start: 20 a second are 5 loops a second.
    assert replay_rate([0, 5 * 10**8, 10**9, 15 * 10**8], 20.0) == pytest.approx(7.5)
    assert replay_rate([3], 20.0) == pytest.approx(20.0)  # a loop of one cloud takes a second


def test_one_benchmark_at_a_time() -> None:
    with ros_environment(), pytest.raises(BenchmarkError, match="another benchmark is running"), ros_environment():
        pass


def test_a_cloud_comes_back_as_grasps() -> None:
    settings = LatencySettings("antipodal", "made-up:20000", threads=1, clouds=3, warm_up=1, pause=0.0)
    record = measure_latency(settings, quiet)
    assert (record.model, record.weights, record.points, record.clouds) == ("antipodal", "none", 20_000, 3)
    assert record.message_bytes >= 20_000 * 12
    assert record.grasps > 0
    assert record.proposals.most < record.detection.most < record.total.most <= record.slowest * 1.5
    assert record.outside.median < record.total.median
    assert set(BEFORE) <= set(record.parts)


def test_a_replayed_bag_gives_grasps_a_second() -> None:
    settings = ThroughputSettings("antipodal", BAG, offered=4.0, seconds=4.0, threads=1, warm_up=0.5)
    record = measure_throughput(settings, quiet)
    assert 0.0 < record.sustained < 8.0
    assert {use.node for use in record.nodes} == {"pipeline", "selector"}
    assert all(use.peak >= use.resident > 10**7 and use.cores >= 0.0 for use in record.nodes)
