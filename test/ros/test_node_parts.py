"""The parts of the nodes that need no running process: mailbox, health, sensor frames."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from std_msgs.msg import Header

from regnet_core.detector import GraspDetector
from regnet_core.geometry import pose_matrix, quaternion_from_matrix
from regnet_core.gripper import Gripper
from regnet_core.ops.parallel import available_cores
from regnet_core.report import StepReport
from regnet_ros.frames import FrameError, SensorFrames
from regnet_ros.health import Health, RateMeter
from regnet_ros.mailbox import Mailbox
from regnet_ros.threads import usable_cores
from regnet_ros.warm_up import made_up_cloud

NODE = cast("Node", None)  # a listener is made for a node only where no buffer is given


def test_the_mailbox_keeps_the_newest() -> None:
    box: Mailbox[int] = Mailbox()
    assert box.take() is None
    assert not box.put(1)
    assert box.put(2)
    assert not box.put_if_empty(3)
    assert box.take() == 2
    assert box.take() is None
    assert box.put_if_empty(4)
    assert box.take() == 4


def test_the_mailbox_loses_nothing_between_threads() -> None:
    box: Mailbox[int] = Mailbox()
    replaced, taken = [], []
    done = threading.Event()

    def put() -> None:
        replaced.extend(number for number in range(20_000) if box.put(number))
        done.set()

    thread = threading.Thread(target=put)
    thread.start()
    while not done.is_set():
        taken.append(box.take())
    thread.join()
    taken.append(box.take())
    got = [number for number in taken if number is not None]
    assert len(got) + len(replaced) == 20_000
    assert got == sorted(set(got))
    assert got[-1] == 19_999


def test_rates_are_averages_over_the_window() -> None:
    meter = RateMeter()
    for tenth in range(100):
        meter.tick(tenth / 10)
    assert meter.rate(9.9) == pytest.approx(10.0, rel=0.05)
    assert meter.rate(12.4) == pytest.approx(5.0, rel=0.05)
    assert meter.rate(100.0) == 0.0


def level(health: Health, state: str = "active", stale_after: float = 60.0) -> tuple[bytes, str]:
    status = health.status("/node", state, stale_after)
    return status.level, status.message


def test_health_goes_through_its_levels() -> None:
    health = Health(awaits="clouds")
    assert level(health) == (DiagnosticStatus.OK, "waiting for clouds")
    assert level(health, stale_after=0.0)[0] == DiagnosticStatus.STALE
    assert level(health, state="inactive")[1].startswith("inactive")
    health.received()
    assert health.succeeded({}, reason="the table is empty")
    assert level(health) == (DiagnosticStatus.WARN, "the table is empty")
    assert not health.succeeded({}, reason="the table is empty")
    health.failed("x is missing")
    assert level(health) == (DiagnosticStatus.ERROR, "x is missing")
    assert level(health, state="inactive") == (DiagnosticStatus.ERROR, "x is missing")
    assert health.succeeded({"total": 0.25}, [StepReport("crop", 5, 2, 0.001)], {"grasps": 3})
    assert level(health) == (DiagnosticStatus.OK, "working")
    assert level(health, stale_after=0.0)[0] == DiagnosticStatus.STALE
    values = {pair.key: pair.value for pair in health.status("/node", "active", 60.0).values}
    assert values["latency total [ms]"] == "250.0"
    assert values["crop"] == "kept 5, rejected 2, 1.0 ms"
    assert (values["grasps"], values["received"], values["processed"], values["failed"]) == ("3", "1", "3", "1")
    assert (values["reason"], values["last error"]) == ("", "x is missing")


class Buffer:
    """Stands for tf2's buffer: knows the pose of one camera."""

    def __init__(self, T_world_camera: np.ndarray) -> None:
        self._pose = T_world_camera

    def lookup_transform(self, target: str, source: str, time: Any, timeout: Any) -> TransformStamped:
        if (target, source) != ("world", "camera"):
            raise LookupError(f'"{source}" passed to lookupTransform argument source_frame does not exist')
        result = TransformStamped()
        t, q = self._pose[:3, 3], quaternion_from_matrix(self._pose[None, :3, :3])[0]
        move, turn = result.transform.translation, result.transform.rotation
        move.x, move.y, move.z = (float(v) for v in t)
        turn.x, turn.y, turn.z, turn.w = (float(v) for v in q)
        return result


def header(frame: str) -> Header:
    return Header(frame_id=frame, stamp=Time(sec=5))


CAMERA = pose_matrix([0.3, -0.2, 1.5], [-2.2, 0.1, 0.7])


@pytest.fixture
def frames() -> SensorFrames:
    return SensorFrames(NODE, Buffer(CAMERA))


def test_the_target_frame_needs_no_transform(frames: SensorFrames) -> None:
    for frame in ("world", "/world"):
        np.testing.assert_array_equal(frames.pose(header(frame), "world", (), 0.1), np.eye(4))


def test_the_transform_of_tf_is_used(frames: SensorFrames) -> None:
    assert frames.knows_tf
    np.testing.assert_allclose(frames.pose(header("camera"), "world", (), 0.1), CAMERA, atol=1e-12)


def test_a_sensor_pose_that_is_given_counts_more(frames: SensorFrames) -> None:
    pose = frames.pose(header("camera"), "world", (1.0, 2.0, 3.0, 0.0, 0.0, np.pi / 2), 0.1)
    np.testing.assert_allclose(pose[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(pose[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)


def test_an_unknown_frame_is_explained(frames: SensorFrames) -> None:
    with pytest.raises(
        FrameError, match=r"no transform from 'other' to 'world' .*does not exist.*: publish .* sensor_pose"
    ):
        frames.pose(header("other"), "world", (), 0.1)
    with pytest.raises(FrameError, match=r"no frame_id.*sensor_pose"):
        frames.pose(header(""), "world", (), 0.1)


def test_health_shows_what_the_node_says_of_itself() -> None:
    health = Health(awaits="clouds")
    health.facts = {"model": "antipodal", "device": "cpu"}
    values = {pair.key: pair.value for pair in health.status("/node", "active", 60.0).values}
    assert (values["model"], values["device"]) == ("antipodal", "cpu")


@pytest.mark.parametrize(
    ("quota", "limit"),
    [("max 100000\n", 64), ("150000 100000\n", 1), ("400000 100000\n", 4), ("50000 100000", 1), ("", 64)],
)
def test_the_quota_of_a_container_limits_the_threads(quota: str, limit: int, tmp_path: Path) -> None:
    (tmp_path / "cpu.max").write_text(quota)
    assert usable_cores(tmp_path / "cpu.max") == min(limit, available_cores())
    assert usable_cores(tmp_path / "none") == available_cores()


@pytest.mark.parametrize(
    ("count", "given", "expected"), [(1, None, 1), (1, "2", 1), (0, "1", 1), (0, None, None)], ids=str
)
def test_torch_uses_the_threads_that_were_asked_for(count: int, given: str | None, expected: int | None) -> None:
    program = (
        f"from regnet_ros.threads import usable_cores, use_threads; use_threads({count}); import torch\n"
        "print(torch.get_num_threads(), usable_cores())"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    environment |= {} if given is None else {"OMP_NUM_THREADS": given}
    output = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    threads, cores = map(int, output.stdout.split())
    assert threads == expected if expected else 1 <= threads <= cores  # MKL counts no hyper-threads


def test_the_warm_up_cloud_has_grasps_and_as_many_points_as_a_network_takes() -> None:
    assert len(made_up_cloud()) >= 25600
    detection = GraspDetector("antipodal").detect(made_up_cloud(), Gripper())
    assert len(detection.grasps) > 0
    assert detection.plane is not None
