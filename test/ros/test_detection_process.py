"""Detections in other processes: the same results and errors, also after one of the processes was ended."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from clouds import SCENE

from regnet_core import CloudError, Detection, GraspDetector, GraspFilters, Gripper, ModelError
from regnet_core.detector import DetectorConfig
from regnet_ros.detection_process import DetectionProcesses, ProcessEndedError, RemoteDetector

CONFIG = DetectorConfig(max_grasps=40)
CAMERA = np.array([0.0, 0.0, 1.5])


@pytest.fixture(scope="module")
def processes() -> Iterator[DetectionProcesses]:
    made = DetectionProcesses(2)
    yield made
    made.end()


@pytest.fixture(scope="module")
def remote(processes: DetectionProcesses) -> RemoteDetector:
    return processes.detector("antipodal", "auto", 0, CONFIG)


@pytest.fixture(scope="module")
def here() -> GraspDetector:
    return GraspDetector("antipodal", config=CONFIG)


def assert_same(found: Detection, expected: Detection) -> None:
    assert len(found.grasps) == len(expected.grasps)
    for name in ("rotation", "translation", "width", "quality", "confidence"):
        np.testing.assert_array_equal(getattr(found.grasps, name), getattr(expected.grasps, name))
    assert (found.gripper, found.plane) == (expected.gripper, expected.plane)
    steps = [(step.name, step.kept, step.rejected) for step in expected.report.steps]
    assert [(step.name, step.kept, step.rejected) for step in found.report.steps] == steps
    assert (found.report.model, found.report.reason) == (expected.report.model, expected.report.reason)


def test_the_same_is_found_as_in_this_process(remote: RemoteDetector, here: GraspDetector) -> None:
    assert (remote.model, remote.device) == (here.model, here.device)
    colors = np.full(SCENE.shape, 128, np.uint8)
    for points, given, width in ((SCENE, None, 0.08), (SCENE[::2], colors[::2], 0.06), (SCENE[:0], None, 0.08)):
        filters, gripper = GraspFilters(min_quality=0.1), Gripper(width=width)
        expected = here.detect(points, gripper, given, filters=filters, viewpoint=CAMERA)
        assert_same(remote.detect(points, gripper, given, filters=filters, viewpoint=CAMERA), expected)
    assert len(expected.grasps) == 0 and expected.report.reason


def test_memory_grows_with_the_clouds(remote: RemoteDetector, here: GraspDetector) -> None:
    for copies in (1, 30, 2):
        points = np.concatenate([SCENE] * copies).astype(np.float32)
        assert_same(remote.detect(points), here.detect(points))


def test_several_may_ask_at_a_time(remote: RemoteDetector, here: GraspDetector) -> None:
    widths = [0.05, 0.06, 0.07, 0.08] * 2
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda width: remote.detect(SCENE, Gripper(width=width)), widths))
    for width, detection in zip(widths, found, strict=True):
        assert_same(detection, here.detect(SCENE, Gripper(width=width)))


def test_errors_are_those_of_the_library(processes: DetectionProcesses, remote: RemoteDetector) -> None:
    with pytest.raises(ModelError, match="no model 'none'"):
        processes.detector("none", "auto", 0, CONFIG)
    with pytest.raises(CloudError, match="shape"):
        remote.detect(np.zeros((5, 2)))
    with pytest.raises(RuntimeError, match="AttributeError"):
        remote.detect(SCENE, filters="none")  # type: ignore[arg-type]
    assert len(remote.detect(SCENE).grasps) == 40


def test_a_process_that_was_ended_is_started_again(
    processes: DetectionProcesses, remote: RemoteDetector, here: GraspDetector
) -> None:
    ended = processes.numbers
    for number in ended:
        os.kill(number, signal.SIGKILL)
    for _ in ended:
        with pytest.raises(ProcessEndedError, match=r"ended \(signal SIGKILL\); it is started again"):
            remote.detect(SCENE)
    assert not set(ended) & set(processes.numbers)
    for _ in ended:
        assert_same(remote.detect(SCENE), here.detect(SCENE))


def test_nothing_is_left_at_the_end() -> None:
    made = DetectionProcesses(2)
    made.detector("random", "cpu", 0, CONFIG)
    numbers = made.numbers
    made.end()
    deadline = time.monotonic() + 20.0
    while any(os.path.exists(f"/proc/{number}") for number in numbers):
        assert time.monotonic() < deadline, "a process is still there"
        time.sleep(0.01)
