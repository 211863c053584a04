"""PointCloud2 messages to arrays and back, the malformed and unusual ones included."""

from __future__ import annotations

import re
import time

import numpy as np
import pytest
from clouds import FLOAT64, ODD_CLOUDS, SCENE, UINT8, XYZ, OddCloud, cloud, field, huge_cloud
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from regnet_core.errors import CloudError
from regnet_ros import received_cloud
from regnet_ros.conversions import cloud_from_message, cloud_to_message
from regnet_ros.received_cloud import CloudReader

REFUSED = [odd for odd in ODD_CLOUDS if odd.decoder]
ACCEPTED = [odd for odd in ODD_CLOUDS if not odd.decoder]


def test_the_table_is_long_enough() -> None:
    names = {odd.name for odd in ODD_CLOUDS}
    assert len(names) == len(ODD_CLOUDS) >= 25


@pytest.mark.parametrize("odd", REFUSED, ids=lambda odd: odd.name)
def test_a_malformed_cloud_is_refused_with_a_clear_message(odd: OddCloud) -> None:
    with pytest.raises(CloudError, match=odd.decoder):
        cloud_from_message(odd.make())


@pytest.mark.parametrize("odd", ACCEPTED, ids=lambda odd: odd.name)
def test_an_unusual_cloud_is_decoded_point_by_point(odd: OddCloud) -> None:
    message = odd.make()
    decoded = cloud_from_message(message)
    assert decoded.points.shape == (message.width * message.height, 3)
    order = ">" if message.is_bigendian else "<"
    offsets = {f.name: (f.offset, f"{order}f{8 if f.datatype == FLOAT64 else 4}") for f in message.fields}
    for index in range(0, len(decoded.points), max(1, len(decoded.points) // 20)):  # one by one, by hand
        row, column = divmod(index, message.width)
        start = row * message.row_step + column * message.point_step
        for axis, name in enumerate("xyz"):
            offset, kind = offsets[name]
            size = np.dtype(kind).itemsize
            expected = np.frombuffer(bytes(message.data[start + offset : start + offset + size]), kind)[0]
            np.testing.assert_equal(decoded.points[index, axis], expected)


@pytest.mark.parametrize("odd", ODD_CLOUDS, ids=lambda odd: odd.name)
def test_a_cloud_is_read_from_its_bytes_as_from_its_message(odd: OddCloud) -> None:
    message = odd.make()
    message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id = -5, 7, "camera"
    reader = CloudReader()
    for _ in range(2):  # the second one has the layout of the first
        received = reader.read(serialize_message(message))
        assert received.header == message.header
        if odd.decoder:
            with pytest.raises(CloudError, match=odd.decoder):
                received.decode()
        else:
            expected, decoded = cloud_from_message(message), received.decode()
            np.testing.assert_array_equal(decoded.points, expected.points)
            np.testing.assert_array_equal(decoded.colors, expected.colors)
        message.header.stamp.sec += 6


def test_clouds_of_different_layouts_are_read_by_turns() -> None:
    colors = np.random.default_rng(0).integers(0, 256, SCENE.shape, dtype=np.uint8)
    messages = [
        cloud_to_message(Header(frame_id="a"), SCENE),
        cloud_to_message(Header(frame_id="b"), SCENE),
        cloud_to_message(Header(frame_id="a"), SCENE[:-1]),
        cloud_to_message(Header(frame_id="a"), SCENE, colors),
        cloud_to_message(Header(), SCENE[::-1]),
    ]
    messages[1].is_dense = False
    reader = CloudReader()
    for number in (0, 1, 0, 0, 2, 3, 4, 2, 1):
        received, expected = reader.read(serialize_message(messages[number])), cloud_from_message(messages[number])
        assert received.header.frame_id == messages[number].header.frame_id
        np.testing.assert_array_equal(received.decode().points, expected.points)
        np.testing.assert_array_equal(received.decode().colors, expected.colors)


def test_points_stay_in_the_message_and_cannot_be_changed() -> None:
    data = serialize_message(cloud_to_message(Header(frame_id="world"), SCENE))
    points = CloudReader().read(data).decode().points
    assert np.shares_memory(points, np.frombuffer(data, np.uint8)) and not points.flags.writeable


def test_bytes_that_are_no_cloud_are_refused() -> None:
    data = serialize_message(cloud_to_message(Header(frame_id="world"), SCENE[:9]))
    assert len(CloudReader().read(data).decode().points) == 9
    for wrong in (b"", data[:3], data[:20], data[:60], data[:-20], b"\0\1\0\0" + b"\xff" * 100):
        with pytest.raises(CloudError, match=f"a PointCloud2 of {len(wrong)} bytes cannot be read"):
            CloudReader().read(wrong)


def test_bytes_in_another_layout_are_read_by_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    data = serialize_message(cloud_to_message(Header(frame_id="world"), SCENE))
    monkeypatch.setattr(received_cloud, "_data_in", lambda message: None)
    received = CloudReader().read(data)
    assert received.header.frame_id == "world"
    np.testing.assert_array_equal(received.decode().points, SCENE.astype(np.float32))


def test_colours_in_every_layout() -> None:
    wanted = np.random.default_rng(0).integers(0, 256, SCENE.shape, dtype=np.uint8)
    packed = wanted[:, 0].astype(np.uint32) << 16 | wanted[:, 1].astype(np.uint32) << 8 | wanted[:, 2]
    channels = (field("r", 12, UINT8), field("g", 13, UINT8), field("b", 14, UINT8))
    bytewise = cloud(SCENE, fields=(*XYZ, *channels), point_step=16, extra=dict(zip("rgb", wanted.T, strict=True)))
    as_float = cloud(SCENE, fields=(*XYZ, field("rgb", 12)), point_step=16, extra={"rgb": packed.view(np.float32)})
    for message in (bytewise, as_float):
        np.testing.assert_array_equal(cloud_from_message(message).colors, wanted)
    assert cloud_from_message(cloud(SCENE)).colors is None


@pytest.mark.parametrize("coloured", [False, True])
def test_round_trip_through_the_wire(coloured: bool) -> None:
    colors = np.random.default_rng(0).integers(0, 256, SCENE.shape, dtype=np.uint8) if coloured else None
    message = cloud_to_message(Header(frame_id="world"), SCENE, colors)
    received = deserialize_message(serialize_message(message), PointCloud2)
    decoded = cloud_from_message(received)
    assert received.header.frame_id == "world"
    np.testing.assert_array_equal(decoded.points, SCENE.astype(np.float32))
    np.testing.assert_array_equal(decoded.colors, colors)


def test_an_empty_cloud_can_be_sent() -> None:
    message = cloud_to_message(Header(frame_id="world"), np.zeros((0, 3)))
    assert message.width == 0
    assert cloud_from_message(message).points.shape == (0, 3)


def test_five_million_points_are_decoded_without_a_loop_over_points() -> None:
    message = huge_cloud(5_000_000)
    start = time.perf_counter()
    decoded = cloud_from_message(message)
    assert decoded.points.shape == (5_000_000, 3)
    assert time.perf_counter() - start < 2.0


def test_refusals_name_the_value_and_the_remedy() -> None:
    short = cloud(SCENE[:100])
    short.width = 101
    with pytest.raises(CloudError) as caught:
        cloud_from_message(short)
    assert re.search(r"need\s+1212 bytes, got 1200", str(caught.value))
