"""Grasps, grippers, reports, poses and markers to messages and back."""

from __future__ import annotations

import re

import numpy as np
import pytest
from grasp_arrays import ODD_ARRAYS, OddArray, array, grasps
from rclpy.serialization import deserialize_message, serialize_message
from regnet_msgs.msg import GraspArray, SelectedGrasp
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from regnet_core import DetectionReport, Grasps, Gripper, InvalidInputError, Plane, StepReport
from regnet_core.geometry import matrix_from_quaternion, pose_matrix
from regnet_core.policy import Selection
from regnet_ros import serialized_grasps
from regnet_ros.conversions import (
    grasp_array,
    grasps_from_messages,
    gripper_from_message,
    gripper_to_message,
    pose_array,
    pose_stamped,
    pose_to_message,
    report_from_message,
)
from regnet_ros.grasp_list import GraspList, _Layout, selected_grasp
from regnet_ros.selector import _candidates
from regnet_ros.serialized_grasps import serialized_grasp_array
from regnet_ros.visuals import grasp_markers, gripper_lines, plane_marker, rank_colour, selection_markers

HEADER = Header(frame_id="world")


def test_grasps_survive_the_wire() -> None:
    sent = grasps()
    steps = (StepReport("proposals", 10, 3, 0.25), StepReport("ranking", 4, 6, 0.001))
    report = DetectionReport(steps, "made-up", "cpu", "", 0.5, ("the cloud is sparse",))
    message = grasp_array(HEADER, sent, Gripper(width=0.07), report)
    received = deserialize_message(serialize_message(message), GraspArray)
    back = grasps_from_messages(received.grasps)
    np.testing.assert_allclose(back.rotation, sent.rotation, atol=1e-12)
    for name in ("translation", "width", "quality", "vertical_score", "confidence"):
        np.testing.assert_array_equal(getattr(back, name), getattr(sent, name))
    assert gripper_from_message(received.gripper) == Gripper(width=0.07)
    assert report_from_message(received) == report


def test_a_middleware_with_another_encoding_gets_what_rclpy_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert serialized_grasps._is_understood()
    given = HEADER, grasps(), Gripper(), DetectionReport((StepReport("ranking", 4, 6, 0.001),), "made-up", "cpu")
    own = serialized_grasp_array(*given)
    for broken in (b"", own[:-9], bytes([7]) + own[1:], own[:72] + bytes(4) + own[76:]):
        serialized_grasps._is_understood.cache_clear()
        monkeypatch.setattr(serialized_grasps, "_written", lambda *_, data=broken: data)
        assert not serialized_grasps._is_understood()
        assert serialized_grasp_array(*given) == serialize_message(grasp_array(*given))
    serialized_grasps._is_understood.cache_clear()


@pytest.mark.parametrize("frame", ["", "w", "world", "camera_1", "Größe/µ", "a_frame_with_a_long_name"])
@pytest.mark.parametrize("count", [0, 1, 2, 250])
def test_an_array_is_serialized_as_rclpy_does_it(frame: str, count: int) -> None:
    rng = np.random.default_rng(count)
    quaternions = rng.normal(size=(count, 4))
    rotation = matrix_from_quaternion(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
    numbers = (rng.normal(size=(count, 3)), *rng.random((3, count)))
    batch = Grasps.from_poses(rotation, *numbers) if count else Grasps.empty()
    steps = (StepReport("proposals", 10, 3, 0.25), StepReport("collision", 4, 6, 0.001))
    report = DetectionReport(steps[: count % 3], "made-up", "cpu", "", 0.5, ("the cloud is sparse",) * (count % 2))
    header = Header(frame_id=frame)
    header.stamp.sec, header.stamp.nanosec = 1_700_000_000, 123_456_789
    expected = serialize_message(grasp_array(header, batch, Gripper(width=0.07), report))
    data = serialized_grasp_array(header, batch, Gripper(width=0.07), report)
    assert len(data) == len(expected)  # what is between fields is anything
    message = deserialize_message(data, GraspArray)
    assert message == deserialize_message(expected, GraspArray)
    received, read = GraspList.of_serialized(data), GraspList.of_message(message)
    assert received[:3] == read[:3] and [received.message(rank) for rank in range(count)] == message.grasps
    np.testing.assert_array_equal(received.numbers, read.numbers)


def test_an_array_in_another_layout_is_read_by_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here grasps seem to begin a number later: the first one is another than rclpy reads."""
    message = array()
    data, right = serialize_message(message), _Layout.numbers
    monkeypatch.setattr(_Layout, "numbers", lambda self, data: right(self, data) + 1.0)
    np.testing.assert_array_equal(GraspList.of_serialized(data).numbers, GraspList.of_message(message).numbers)
    for wrong in (b"", data[:40], b"\1" + data[1:], data[:1] + b"\7" + data[2:]):
        assert _Layout.of(wrong) is None


def test_random_rotations_survive() -> None:
    quaternions = np.random.default_rng(0).normal(size=(200, 4))
    rotation = matrix_from_quaternion(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
    sent = Grasps.from_poses(rotation, np.zeros((200, 3)), np.full(200, 0.05), np.ones(200))
    received = grasps_from_messages(array(batch=sent).grasps)
    np.testing.assert_allclose(received.rotation, sent.rotation, atol=1e-12)


def test_no_grasps() -> None:
    message = array(batch=Grasps.empty(), reason="nothing there")
    assert (len(message.grasps), message.reason) == (0, "nothing there")
    assert len(grasps_from_messages(message.grasps)) == 0
    assert pose_array(HEADER, Grasps.empty()).poses == []


def test_the_pose_message_has_the_axes_of_the_grasp_frame() -> None:
    """Turned by 90 degrees about y: the approach X points straight down."""
    pose = pose_to_message(pose_matrix([1.0, 2.0, 3.0], [0.0, np.pi / 2, 0.0]))
    assert (pose.position.x, pose.position.y, pose.position.z) == (1.0, 2.0, 3.0)
    half = np.sqrt(0.5)
    np.testing.assert_allclose([pose.orientation.y, pose.orientation.w], [half, half])


def test_every_gripper_survives_and_a_bad_one_is_refused() -> None:
    gripper = Gripper(0.05, 0.04, 0.03, 0.02, 0.1)
    assert gripper_from_message(gripper_to_message(gripper)) == gripper
    message = gripper_to_message(gripper)
    message.width = 0.5
    with pytest.raises(InvalidInputError, match=r"width must be in \[0\.03, 0\.16\] m, got 0\.5"):
        gripper_from_message(message)


@pytest.mark.parametrize("odd", [o for o in ODD_ARRAYS if not o.name.startswith("no grasps")], ids=lambda odd: odd.name)
def test_an_odd_array_is_refused_with_a_clear_message(odd: OddArray) -> None:
    message = array()
    odd.change(message)
    with pytest.raises(InvalidInputError) as caught:
        _candidates(GraspList.of_message(message))
    assert re.search(odd.message, str(caught.value))


def selection(rank: int = 2) -> SelectedGrasp:
    return selected_grasp(GraspList.of_message(array()), grasps(), Selection(rank, 1.5, "heuristic"), 0.12, 0.2)


def test_a_selection_has_the_way_to_the_grasp_and_up() -> None:
    message, pose = selection(), grasps()[2].poses[0]
    before = np.array([message.pre_grasp.position.x, message.pre_grasp.position.y, message.pre_grasp.position.z])
    np.testing.assert_allclose(before, pose[:3, 3] - 0.12 * pose[:3, 0])
    assert message.lift.position.z == pytest.approx(pose[2, 3] + 0.2)
    assert (message.lift.position.x, message.lift.position.y) == pytest.approx(tuple(pose[:2, 3]))
    for way_point in (message.pre_grasp, message.lift):
        assert way_point.orientation.w == pytest.approx(message.grasp.orientation.w)
    assert (message.rank, message.score, message.policy) == (2, 1.5, "heuristic")
    assert message.selected == array().grasps[2]
    assert pose_stamped(message).pose == message.grasp


def test_outlines_are_the_hand_in_the_grasp_frame() -> None:
    lines = gripper_lines(Gripper(), 0.05)
    assert lines.shape == (4, 2, 3)
    assert lines[:, :, 0].min() == -0.06 and lines[:, :, 0].max() == 0.06
    fingers = lines[2:]
    np.testing.assert_allclose(np.abs(fingers[..., 1]), 0.03)  # the middle of a 0.01 m finger beside 0.025 m
    np.testing.assert_allclose(fingers[:, 1, 0], 0.06)


def test_markers_go_from_green_to_red_after_a_deletion() -> None:
    markers = grasp_markers(HEADER, grasps(), Gripper(), most=3).markers
    assert [m.action for m in markers] == [Marker.DELETEALL, Marker.ADD, Marker.ADD, Marker.ADD]
    assert [m.id for m in markers[1:]] == [0, 1, 2]
    assert all(m.header == HEADER for m in markers)
    assert all(len(m.points) % 2 == 0 and len(m.points) > 0 for m in markers[1:])
    best, last = rank_colour(0, 10), rank_colour(9, 10)
    assert (best.r, best.g) == (0.0, 1.0)
    assert (last.r, last.g) == (1.0, 0.0)
    assert rank_colour(0, 1).g == 1.0
    assert len(grasp_markers(HEADER, Grasps.empty(), Gripper(), most=3).markers) == 1


def test_the_selected_hand_is_drawn_where_it_is() -> None:
    message = selection(rank=1)  # straight down, fingers along y
    clear, palm, left, right, way = selection_markers(message).markers
    assert clear.action == Marker.DELETEALL
    assert palm.pose.position.z == pytest.approx(0.8 + 0.03)
    assert left.pose.position.z == right.pose.position.z == pytest.approx(0.8 - 0.03)
    assert abs(left.pose.position.y - right.pose.position.y) == pytest.approx(0.06 + 0.01)
    assert [p.z for p in way.points] == pytest.approx([0.92, 0.8, 1.0])


def test_the_plane_is_a_plate_under_the_points() -> None:
    points = np.array([[0.0, 0.0, 0.5], [0.4, 0.2, 0.6], [0.2, 0.1, 0.8]])
    marker = plane_marker(HEADER, Plane((0.0, 0.0, 1.0), 0.5), points)
    assert (marker.scale.x, marker.scale.y) == pytest.approx((0.4, 0.2))
    assert (marker.pose.position.x, marker.pose.position.y, marker.pose.position.z) == pytest.approx((0.2, 0.1, 0.5))
    assert marker.pose.orientation.w == pytest.approx(1.0)
    assert plane_marker(HEADER, None, points).action == Marker.DELETE
    assert plane_marker(HEADER, Plane((0.0, 0.0, 1.0), 0.5), points[:0]).action == Marker.DELETE
