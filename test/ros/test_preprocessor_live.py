"""The preprocessor as a process: transform, workspace, down-sampling, support plane, start without autostart."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from clouds import SCENE, TABLE, XYZ, cloud, field
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from live import REPOSITORY, NodeProcess, Peer, System, TimeExpiredError, wait_for
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker

from regnet_core.geometry import pose_matrix, transform_points
from regnet_ros.conversions import cloud_from_message
from regnet_ros.settings import PreprocessorParameters

CHANGED = ("target_frame", "crop_min", "crop_max", "voxel_size", "max_points", "seed", "max_rate", "keep_pace")


class Preprocessor:
    """The running node with its topics."""

    def __init__(self, system: System) -> None:
        self.peer: Peer = system.peer
        self.process: NodeProcess = system.start("preprocessor", "--ros-args", "-p", "autostart:=false")
        self.clouds = self.peer.listen(PointCloud2, "cloud")
        self.planes = self.peer.listen(Marker, "support_plane", latched=True)
        self._stamp = 0

    def send(self, message: PointCloud2 | None = None) -> PointCloud2:
        message = message or cloud(SCENE)
        self._stamp += 1
        message.header.stamp.sec = self._stamp
        for inbox in (self.clouds, self.planes, self.peer.diagnostics):
            inbox.clear()
        self.peer.publisher(PointCloud2, "points").publish(message)
        return message

    def prepared(self, message: PointCloud2 | None = None) -> np.ndarray:
        """The points that come out."""
        sent = self.send(message)
        received = self.clouds.wait(lambda m: m.header.stamp == sent.header.stamp, what="prepared cloud")
        assert received.header.frame_id == "world"
        return cloud_from_message(received).points

    def change(self, **values: Any) -> None:
        result = self.peer.set_parameters("preprocessor", values)
        assert result.successful, result.reason

    def set_pose(self, pose: list[float]) -> None:
        self.change(sensor_pose=np.array(pose).tolist())


@pytest.fixture(scope="module")
def preprocessor(system: System) -> Preprocessor:
    return Preprocessor(system)


@pytest.fixture(autouse=True)
def _defaults_after_each_test(preprocessor: Preprocessor) -> Iterator[None]:
    yield
    defaults = PreprocessorParameters()
    preprocessor.change(**{name: getattr(defaults, name) for name in CHANGED})


def test_without_autostart_the_node_waits_for_transitions(preprocessor: Preprocessor) -> None:
    peer = preprocessor.peer
    assert peer.state("preprocessor") == "unconfigured"
    assert peer.node.count_publishers("/cloud") == 0
    assert peer.wait_for_status("preprocessor").message.startswith("unconfigured")
    assert peer.change_state("preprocessor", Transition.TRANSITION_CONFIGURE)
    assert peer.state("preprocessor") == "inactive"
    preprocessor.send()
    with pytest.raises(TimeExpiredError):
        preprocessor.clouds.wait(timeout=0.5)
    assert peer.change_state("preprocessor", Transition.TRANSITION_ACTIVATE)
    assert len(preprocessor.prepared()) == len(SCENE)


def test_the_cloud_keeps_its_stamp_and_its_points(preprocessor: Preprocessor) -> None:
    np.testing.assert_allclose(preprocessor.prepared(), SCENE, atol=1e-6)


def test_invalid_points_go(preprocessor: Preprocessor) -> None:
    points = np.concatenate([SCENE, np.full((10, 3), np.nan), np.full((10, 3), np.inf), np.full((10, 3), 5e4)])
    np.testing.assert_allclose(preprocessor.prepared(cloud(points)), SCENE, atol=1e-6)


def test_an_unknown_camera_frame_is_explained(preprocessor: Preprocessor) -> None:
    preprocessor.send(cloud(SCENE, frame="camera"))
    status = preprocessor.peer.wait_for_status("preprocessor", lambda s: s.level == DiagnosticStatus.ERROR)
    assert re.search(r"frame 'camera'.*'world'.*sensor_pose", status.message), status.message
    assert preprocessor.clouds.all() == []


def test_the_target_frame_can_be_the_cameras_own(preprocessor: Preprocessor) -> None:
    preprocessor.change(target_frame="base")
    sent = preprocessor.send(cloud(SCENE, frame="base"))
    assert preprocessor.clouds.wait().header == sent.header


def test_crop(preprocessor: Preprocessor) -> None:
    preprocessor.change(crop_min=[-0.1, -0.1, TABLE + 0.01], crop_max=[0.1, 0.1, 2.0])
    points = preprocessor.prepared()
    inside = (np.abs(SCENE[:, :2]) <= 0.1).all(axis=1) & (SCENE[:, 2] >= TABLE + 0.01)
    assert len(points) == inside.sum() > 0
    refused = preprocessor.peer.set_parameter("preprocessor", "crop_max", [0.1, -0.2, 2.0])
    assert not refused.successful
    assert "crop_min must be less than crop_max, got -0.1 and -0.2 m in y" in refused.reason


def test_a_crop_that_leaves_nothing_is_explained_and_an_empty_cloud_goes_on(preprocessor: Preprocessor) -> None:
    preprocessor.change(crop_min=[5.0, 5.0, 5.0], crop_max=[6.0, 6.0, 6.0])
    assert len(preprocessor.prepared()) == 0
    status = preprocessor.peer.wait_for_status("preprocessor", lambda s: s.level == DiagnosticStatus.WARN)
    assert "outside the workspace" in status.message


def test_down_sampling_is_repeatable(preprocessor: Preprocessor) -> None:
    preprocessor.change(voxel_size=0.02)
    thinned = preprocessor.prepared()
    cells = {tuple(cell) for cell in np.floor(thinned / 0.02).astype(int)}
    assert len(SCENE) / 40 < len(thinned) < len(SCENE) / 4
    assert len(cells) == len(thinned)
    preprocessor.change(voxel_size=0.0, max_points=500)
    first, second = preprocessor.prepared(), preprocessor.prepared()
    assert len(first) == 500
    np.testing.assert_array_equal(first, second)
    preprocessor.change(seed=1)
    assert not np.array_equal(preprocessor.prepared(), first)


def test_colours_stay_with_their_points(preprocessor: Preprocessor) -> None:
    red = np.clip(SCENE[:, 0] * 100 + 100, 0, 255).astype(np.uint32)
    layout = {"fields": (*XYZ, field("rgb", 12)), "point_step": 16}
    message = cloud(SCENE, **layout, extra={"rgb": (red << 16).view(np.float32)})
    preprocessor.change(max_points=300)
    preprocessor.send(message)
    decoded = cloud_from_message(preprocessor.clouds.wait())
    assert decoded.colors is not None
    np.testing.assert_allclose(decoded.colors[:, 0], decoded.points[:, 0] * 100 + 100, atol=1.01)


def test_the_support_plane_is_shown_latched(preprocessor: Preprocessor) -> None:
    preprocessor.prepared()
    late = preprocessor.peer.listen(Marker, "support_plane", latched=True)
    marker = late.wait(lambda m: m.action == Marker.ADD)
    assert marker.header.frame_id == "world"
    assert marker.pose.position.z == pytest.approx(TABLE, abs=0.002)
    assert marker.scale.x == pytest.approx(0.5, abs=0.01)
    preprocessor.prepared(cloud(SCENE[:30]))
    assert preprocessor.planes.wait().action == Marker.DELETE


def test_a_sensor_pose_moves_the_cloud(preprocessor: Preprocessor) -> None:
    pose = [0.4, -0.1, 1.6, math.radians(-130), 0.0, math.radians(90)]
    T_world_camera = pose_matrix(pose[:3], pose[3:])
    seen = transform_points(np.linalg.inv(T_world_camera), SCENE)
    preprocessor.set_pose(pose)
    np.testing.assert_allclose(preprocessor.prepared(cloud(seen, frame="camera")), SCENE, atol=1e-5)
    np.testing.assert_allclose(preprocessor.prepared(cloud(seen, frame="")), SCENE, atol=1e-5)
    np.testing.assert_allclose(preprocessor.prepared(cloud(SCENE)), SCENE, atol=1e-6)  # already there
    refused = preprocessor.peer.set_parameter("preprocessor", "sensor_pose", [0.0, 1.0])
    assert not refused.successful
    assert "sensor_pose must be an empty list or 6 numbers" in refused.reason


def test_no_more_clouds_than_asked_for_and_always_the_newest(preprocessor: Preprocessor) -> None:
    publisher = preprocessor.peer.publisher(PointCloud2, "points")
    sent = [cloud(SCENE, stamp=5000 + number) for number in range(6)]
    preprocessor.change(max_rate=1.0)
    preprocessor.prepared()
    preprocessor.clouds.clear()
    for message in sent:
        publisher.publish(message)
    assert preprocessor.clouds.wait(lambda m: m.header == sent[-1].header, what="the newest cloud")
    assert len(preprocessor.clouds.all()) <= 2


def test_with_a_detector_a_cloud_is_prepared_when_it_asks_and_always_the_newest(preprocessor: Preprocessor) -> None:
    peer = preprocessor.peer
    clouds, requests = peer.publisher(PointCloud2, "points"), peer.publisher(Duration, "next_cloud")
    preprocessor.change(keep_pace=True)
    requests.publish(Duration())
    preprocessor.prepared()
    requests.publish(Duration(sec=1000))  # not soon: what comes now waits
    peer.introduce("preprocessor")
    for number in range(3):
        clouds.publish(cloud(SCENE, stamp=6000 + number))
    with pytest.raises(TimeExpiredError):
        preprocessor.clouds.wait(lambda m: m.header.stamp.sec >= 6000, timeout=0.5)
    requests.publish(Duration(nanosec=1))
    assert preprocessor.clouds.wait(lambda m: m.header.stamp.sec >= 6000).header.stamp.sec == 6002
    requests.publish(Duration(sec=1000))
    preprocessor.change(keep_pace=False)
    assert len(preprocessor.prepared()) == len(SCENE)
    preprocessor.change(keep_pace=True)
    requests.publish(Duration(sec=1000))
    peer.introduce("preprocessor")
    preprocessor.send()
    peer.forget_publisher("next_cloud", reliable=True)  # the detector has gone
    assert preprocessor.clouds.wait().width == len(SCENE)


def test_best_effort_for_as_long_as_there_is_a_best_effort_publisher(preprocessor: Preprocessor) -> None:
    peer = preprocessor.peer
    assert peer.reliability("/points") == {ReliabilityPolicy.RELIABLE}
    message = cloud(SCENE, stamp=12345)
    preprocessor.clouds.clear()
    peer.publisher(PointCloud2, "points", reliable=False).publish(message)
    assert preprocessor.clouds.wait(lambda m: m.header.stamp.sec == 12345).width == len(SCENE)
    wait_for(lambda: peer.reliability("/points") == {ReliabilityPolicy.BEST_EFFORT}, "best-effort delivery")
    peer.forget_publisher("points", reliable=False)
    wait_for(lambda: peer.reliability("/points") == {ReliabilityPolicy.RELIABLE}, "reliable delivery again")
    assert len(preprocessor.prepared()) == len(SCENE)


LARGE_BEST_EFFORT = """
import time
import numpy as np, rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header
from sensor_msgs.msg import PointCloud2
from regnet_ros.conversions import cloud_to_message
rclpy.init()
node = rclpy.create_node("camera")
points = np.random.default_rng(0).uniform(0.5, 1.0, (300_000, 3))
message = cloud_to_message(Header(frame_id="world"), points)
message.header.stamp.sec = 777
publisher = node.create_publisher(PointCloud2, "points", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
while rclpy.ok():
    publisher.publish(message)
    time.sleep(0.3)
"""


def test_large_best_effort_clouds_are_heard_with_the_profile_that_is_delivered(
    system: System, preprocessor: Preprocessor
) -> None:
    profile = str(REPOSITORY / "config" / "fastdds_large_clouds.xml")
    domain = str(system.domain)
    camera = subprocess.Popen(
        [sys.executable, "-c", LARGE_BEST_EFFORT],
        cwd=REPOSITORY,
        env={**os.environ, "ROS_DOMAIN_ID": domain, "FASTRTPS_DEFAULT_PROFILES_FILE": profile},
    )
    try:
        assert preprocessor.clouds.wait(lambda m: m.header.stamp.sec == 777).width == 300_000
    finally:
        camera.kill()
        camera.wait()
