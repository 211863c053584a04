"""The detector as a process, with the model antipodal: results, parameters set from outside, service, states."""

from __future__ import annotations

import math
import os
import signal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from clouds import SCENE, XYZ, box_on_table, cloud, field
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from lifecycle_msgs.msg import Transition
from live import NodeProcess, Peer, System, TimeExpiredError, values_of, wait_for
from rcl_interfaces.msg import ParameterType, ParameterValue
from rclpy.qos import ReliabilityPolicy
from rclpy.serialization import serialize_message
from regnet_msgs.msg import GraspArray
from regnet_msgs.msg import Gripper as GripperMessage
from regnet_msgs.srv import DetectGrasps
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from regnet_core import GraspDetector, Gripper
from regnet_ros.conversions import grasps_from_messages


class Counters(NamedTuple):
    """What the diagnostics say about the clouds that came in."""

    received: int
    dropped: int
    input_rate: float
    output_rate: float


class Detector:
    """The running node with its topics."""

    def __init__(self, system: System) -> None:
        self.peer: Peer = system.peer
        self.process: NodeProcess = system.start_node(
            "detector", model="antipodal", max_grasps=40, max_markers=10, at_a_time=2
        )
        self.grasps = self.peer.listen(GraspArray, "grasps")
        self.poses = self.peer.listen(PoseArray, "grasp_poses")
        self.markers = self.peer.listen(MarkerArray, "grasp_markers")
        self._stamp = 100

    def send(self, points: np.ndarray = SCENE, *, reliable: bool = True) -> PointCloud2:
        self._stamp += 1
        message = cloud(points, stamp=self._stamp)
        self.peer.publisher(PointCloud2, "cloud", reliable=reliable).publish(message)
        return message

    def result(self, points: np.ndarray = SCENE) -> GraspArray:
        message = self.send(points)
        return self.grasps.wait(lambda array: array.header == message.header, what="GraspArray")

    def counters(self) -> Counters:
        self.peer.diagnostics.clear()
        numbers = values_of(self.peer.wait_for_status("detector"))
        return Counters(
            int(numbers["received"]),
            int(numbers["dropped for a newer one"]),
            float(numbers["input rate [Hz]"]),
            float(numbers["output rate [Hz]"]),
        )

    def change(self, **values: Any) -> None:
        result = self.peer.set_parameters("detector", values)
        assert result.successful, result.reason


@pytest.fixture(scope="module")
def detector(system: System) -> Detector:
    return Detector(system)


def test_ranked_grasps_with_the_clouds_header_and_a_report(detector: Detector) -> None:
    result = detector.result()
    assert result.header.frame_id == "world"
    assert 0 < len(result.grasps) <= 40
    qualities = [grasp.quality for grasp in result.grasps]
    assert qualities == sorted(qualities, reverse=True)
    assert result.model == "antipodal" and result.device == "cpu" and result.reason == ""
    assert result.steps[0].kept == len(SCENE)
    assert 0.0 < sum(step.seconds for step in result.steps) <= result.total_seconds
    for grasp in result.grasps:
        position = grasp.pose.position
        assert 0.05 - 1e-3 <= grasp.width <= 0.08  # the box is 0.05 m wide, the other sides are too wide for the jaw
        assert math.dist((position.x, position.y, position.z), (0.0, 0.0, 0.84)) < 0.12


def test_the_node_adds_nothing_to_what_the_library_finds(detector: Detector) -> None:
    received = grasps_from_messages(detector.result().grasps)
    expected = GraspDetector("antipodal").detect(SCENE.astype(np.float32), Gripper()).grasps[:40]
    np.testing.assert_allclose(received.translation, expected.translation, atol=1e-9)
    np.testing.assert_allclose(received.rotation, expected.rotation, atol=1e-9)
    np.testing.assert_allclose(received.quality, expected.quality)


def test_poses_and_markers_show_the_same_grasps(detector: Detector) -> None:
    result = detector.result()
    poses = detector.poses.wait(lambda array: array.header == result.header)
    assert poses.poses == [grasp.pose for grasp in result.grasps]
    markers = detector.markers.wait(lambda array: array.markers[0].header == result.header).markers
    assert markers[0].action == Marker.DELETEALL
    assert len(markers) == 1 + min(10, len(result.grasps))
    assert [marker.pose for marker in markers[1:]] == poses.poses[:10]
    assert markers[1].color.g > markers[1].color.r
    assert markers[-1].color.r > markers[-1].color.g


def test_the_node_goes_on_where_a_process_that_detects_is_killed(detector: Detector) -> None:
    tasks = Path(f"/proc/{detector.process.pid}/task").glob("*/children")
    children = [int(word) for task in tasks for word in task.read_text().split()]
    assert len(children) == 2  # one for each of at_a_time
    for child in children:
        os.kill(child, signal.SIGKILL)
    answers = [detector.result() for _ in range(4)]  # a cloud that met a dying process is answered with the reason
    assert all(answer.grasps or answer.reason.endswith("was ended: signal SIGKILL") for answer in answers)
    assert answers[2].grasps and answers[3].grasps


def test_the_same_cloud_gives_the_same_grasps(detector: Detector) -> None:
    first, second = detector.result(), detector.result()
    assert len(first.grasps) > 0
    assert [serialize_message(grasp) for grasp in first.grasps] == [serialize_message(g) for g in second.grasps]


def test_the_width_set_from_another_process_is_that_of_the_next_array(detector: Detector) -> None:
    assert detector.peer.set_parameter("detector", "gripper_width", 0.06).successful
    result = detector.result()
    assert result.gripper.width == 0.06
    assert 0 < max(grasp.width for grasp in result.grasps) <= 0.06
    assert detector.peer.set_parameter("detector", "gripper_width", 0.04).successful
    narrow = detector.result()
    assert narrow.gripper.width == 0.04
    assert all(grasp.width <= 0.04 for grasp in narrow.grasps)
    detector.change(gripper_width=0.08)
    assert detector.result().gripper.width == 0.08


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("gripper_width", 0.5, "gripper_width must be in [0.03, 0.16]; got 0.5"),
        ("gripper_width", 0, "gripper_width must be in [0.03, 0.16]; got 0"),
        ("gripper_width", "wide", "gripper_width must be a number, in [0.03, 0.16]; got the text 'wide'"),
        ("gripper_width", True, "gripper_width must be a number, in [0.03, 0.16]; got true"),
        ("gripper_width", ParameterValue(type=ParameterType.PARAMETER_NOT_SET), "got nothing"),
        ("gripper_width", ParameterValue(type=200), "not a parameter's value"),
        ("gripper_depth", 3.0, "gripper_depth must be in [0.01, 0.2]; got 3"),
        ("model", "nonsense", "'antipodal', 'random', or the path of a .safetensors file; got the text 'nonsense'"),
        ("device", "toaster", "not on 'toaster'"),
        ("approach_axis", [0.0, 0.0, 0.0], "approach_axis must be a direction"),
        ("workspace_min", [2000.0, 0.0, 0.0], "workspace_min must be 3 numbers, in [-1000, 1000]"),
        ("warm_up", False, "warm_up is fixed once the node runs"),
        ("griper_width", 0.08, "there is no parameter 'griper_width'; did you mean 'gripper_width'?"),
    ],
)
def test_a_value_that_cannot_be_is_refused_and_nothing_changes(
    detector: Detector, name: str, value: Any, message: str
) -> None:
    result = detector.peer.set_parameter("detector", name, value)
    assert not result.successful
    assert message in result.reason
    assert detector.peer.get_parameter("detector", "gripper_width") == 0.08


def test_one_bad_value_of_several_leaves_all_as_they_are(detector: Detector) -> None:
    result = detector.peer.set_parameters("detector", {"gripper_width": 0.05, "gripper_depth": 9.0})
    assert not result.successful
    assert detector.peer.get_parameter("detector", "gripper_width") == 0.08


def test_the_range_can_be_asked_for(detector: Detector) -> None:
    description = detector.peer.describe_parameter("detector", "gripper_width")
    assert description.floating_point_range[0].to_value == 0.16
    assert "opening" in description.description


def test_filters_take_effect_at_the_next_cloud(detector: Detector) -> None:
    best = detector.result().grasps[0].quality
    detector.change(max_grasps=5)
    assert len(detector.result().grasps) == 5
    detector.change(max_grasps=40, approach_max_angle=math.radians(20))
    assert all(grasp.vertical_score > 0.5 + 70 / 180 - 1e-6 for grasp in detector.result().grasps)
    detector.change(approach_max_angle=math.pi, workspace_min=[0.5, 0.5, 0.0], workspace_max=[1.0, 1.0, 2.0])
    outside = detector.result()
    assert not outside.grasps
    assert "workspace" in outside.reason
    detector.change(workspace_min=[-1000.0] * 3, workspace_max=[1000.0] * 3, min_quality=1.0)
    assert not detector.result().grasps
    detector.change(min_quality=0.0)
    assert detector.result().grasps[0].quality == best


def test_a_change_is_applied_to_the_last_cloud_when_that_is_wanted(detector: Detector) -> None:
    last = detector.result()
    detector.grasps.clear()
    detector.change(redetect_on_change=True)
    detector.change(gripper_width=0.07)
    again = detector.grasps.wait()
    assert again.header == last.header
    assert again.gripper.width == 0.07
    detector.grasps.clear()
    detector.change(stale_after=4.0)  # changes no result
    with pytest.raises(TimeExpiredError):
        detector.grasps.wait(timeout=0.5)
    detector.change(redetect_on_change=False, gripper_width=0.08)
    with pytest.raises(TimeExpiredError):
        detector.grasps.wait(timeout=0.5)


def test_the_service_with_the_nodes_gripper_and_with_its_own(detector: Detector) -> None:
    request = DetectGrasps.Request(cloud=cloud(SCENE, stamp=7))
    response = detector.peer.call(DetectGrasps, "detect_grasps", request)
    assert response.success and response.message == ""
    assert response.grasps.header == request.cloud.header
    assert response.grasps.gripper.width == 0.08
    own = GripperMessage(width=0.055, depth=0.05, height=0.02, thickness=0.008, palm_depth=0.04)
    response = detector.peer.call(
        DetectGrasps, "detect_grasps", DetectGrasps.Request(cloud=cloud(SCENE), use_gripper=True, gripper=own)
    )
    assert response.success
    assert response.grasps.gripper == own
    assert all(grasp.width <= 0.055 for grasp in response.grasps.grasps)


def test_the_service_refuses_a_gripper_out_of_range_and_reports_an_empty_scene(detector: Detector) -> None:
    request = DetectGrasps.Request(cloud=cloud(SCENE), use_gripper=True, gripper=GripperMessage(width=0.5))
    response = detector.peer.call(DetectGrasps, "detect_grasps", request)
    assert not response.success
    assert "width must be in [0.03, 0.16] m, got 0.5" in response.message
    empty = detector.peer.call(DetectGrasps, "detect_grasps", DetectGrasps.Request(cloud=cloud(SCENE[:0])))
    assert empty.success
    assert "empty" in empty.grasps.reason


def test_parameters_answer_and_the_newest_cloud_wins_while_clouds_come_too_fast(detector: Detector) -> None:
    big = np.concatenate([box_on_table(spacing=0.002) + np.array([0, 0, 0.0003 * i]) for i in range(4)])
    before = detector.counters()
    sent = [detector.send(big) for _ in range(25)]
    assert detector.peer.get_parameter("detector", "gripper_width") == 0.08
    done = detector.grasps.wait(lambda array: array.header == sent[-1].header, what="result of the newest cloud")
    assert len(done.grasps) > 0
    stamps = [array.header.stamp.sec for array in detector.grasps.all()]
    worked_on = [message for message in sent if message.header.stamp.sec in stamps]
    assert len(worked_on) < len(sent)  # some were passed over ...
    after = detector.counters()
    assert after.dropped - before.dropped == after.received - before.received - len(worked_on)  # ... and are counted
    assert after.input_rate > after.output_rate


def test_arrays_come_in_the_order_of_their_clouds(detector: Detector) -> None:
    """Of two clouds that are worked on at a time the small one is done first."""
    detector.grasps.clear()
    small = SCENE[::20]
    stamps = [detector.send(points).header.stamp.sec for points in (SCENE, small) * 10]
    detector.grasps.wait(lambda array: array.header.stamp.sec == stamps[-1], what="the last GraspArray")
    came = [array.header.stamp.sec for array in detector.grasps.all()]
    assert came == sorted(came) and len(came) > 1


def test_colours_are_accepted(detector: Detector) -> None:
    packed = np.full(len(SCENE), 0x00102030, np.uint32).view(np.float32)
    message = cloud(SCENE, fields=(*XYZ, field("rgb", 12)), point_step=16, extra={"rgb": packed}, stamp=99)
    detector.peer.publisher(PointCloud2, "cloud").publish(message)
    assert detector.grasps.wait(lambda array: array.header.stamp == Time(sec=99)).grasps


def test_a_best_effort_publisher_is_heard(detector: Detector) -> None:
    message = detector.send(reliable=False)
    assert detector.grasps.wait(lambda array: array.header == message.header).grasps
    message = detector.send()  # and a reliable one still is
    assert detector.grasps.wait(lambda array: array.header == message.header).grasps
    detector.peer.forget_publisher("cloud", reliable=False)
    wait_for(lambda: detector.peer.reliability("/cloud") == {ReliabilityPolicy.RELIABLE}, "reliable delivery again")


def test_lifecycle_from_outside(detector: Detector) -> None:
    peer = detector.peer
    assert peer.change_state("detector", Transition.TRANSITION_DEACTIVATE)
    assert peer.state("detector") == "inactive"
    detector.grasps.clear()
    peer.diagnostics.clear()
    detector.send()
    assert peer.wait_for_status("detector").message.startswith("inactive")
    response = peer.call(DetectGrasps, "detect_grasps", DetectGrasps.Request(cloud=cloud(SCENE)))
    assert not response.success and "inactive" in response.message
    assert detector.grasps.all() == []
    assert not peer.change_state("detector", Transition.TRANSITION_CONFIGURE)  # not possible from here
    assert peer.change_state("detector", Transition.TRANSITION_ACTIVATE)
    assert detector.result().grasps
    assert peer.change_state("detector", Transition.TRANSITION_DEACTIVATE)
    assert peer.change_state("detector", Transition.TRANSITION_CLEANUP)
    assert peer.state("detector") == "unconfigured"
    wait_for(lambda: peer.node.count_publishers("/grasps") == 0, "the topics to go")
    assert peer.change_state("detector", Transition.TRANSITION_CONFIGURE)
    assert peer.change_state("detector", Transition.TRANSITION_ACTIVATE)
    assert detector.result().grasps


def test_stale_without_input(detector: Detector) -> None:
    detector.change(stale_after=0.2)
    detector.peer.diagnostics.clear()
    status = detector.peer.wait_for_status("detector", lambda s: s.level == DiagnosticStatus.STALE)
    assert "/cloud (" in status.message
    detector.change(stale_after=5.0)


def test_shutdown_from_outside_is_final_and_the_process_still_ends_cleanly(detector: Detector) -> None:
    assert detector.peer.change_state("detector", Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert detector.peer.state("detector") == "finalized"
    detector.process.signal(2)
    assert detector.process.wait() == 0
    assert "Traceback" not in detector.process.output
