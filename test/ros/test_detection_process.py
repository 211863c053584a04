"""Detections in other processes: the same results and errors, also after one of the processes was ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from clouds import SCENE

from regnet_core import CloudError, Detection, GraspDetector, GraspFilters, Gripper, ModelError
from regnet_core.detector import DetectorConfig
from regnet_ros.detection_process import DetectionProcesses, ProcessEndedError, RemoteDetector, _Running

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


def alive(number: int) -> bool:
    """Whether there is such a process, and it has not ended."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def kill(processes: DetectionProcesses) -> None:
    """Kill all of them, and wait for it."""
    for process in processes._all:
        assert process._running is not None
        process._running.program.kill()
        process._running.program.wait(60)


def descriptors() -> int:
    """How many this process has open."""
    return len(os.listdir("/proc/self/fd"))


def wait_until(there: Callable[[], bool]) -> None:
    end = time.monotonic() + 60.0
    while not there():
        assert time.monotonic() < end, "it did not come to this within a minute"
        time.sleep(0.01)


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


def test_a_process_that_was_ended_between_two_clouds_is_started_again(
    processes: DetectionProcesses, remote: RemoteDetector, here: GraspDetector
) -> None:
    ended = processes.numbers
    kill(processes)
    for _ in ended * 2:
        assert_same(remote.detect(SCENE), here.detect(SCENE))
    assert len(processes.numbers) == 2 and not set(ended) & set(processes.numbers)


def test_a_process_that_is_ended_in_the_middle_of_a_detection(
    processes: DetectionProcesses, remote: RemoteDetector, here: GraspDetector
) -> None:
    for number in processes.numbers:
        os.kill(number, signal.SIGSTOP)  # it will be in the middle for as long as we like
    with ThreadPoolExecutor(2) as pool:
        asked = [pool.submit(remote.detect, SCENE) for _ in range(2)]
        time.sleep(0.05)
        assert not any(one.done() for one in asked)
        for number in processes.numbers:
            os.kill(number, signal.SIGKILL)
        for one in asked:
            with pytest.raises(ProcessEndedError, match="the process that detects was ended: signal SIGKILL"):
                one.result(timeout=60)
    assert_same(remote.detect(SCENE), here.detect(SCENE))


def test_one_that_cannot_be_started_is_tried_again(
    processes: DetectionProcesses, remote: RemoteDetector, here: GraspDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(threads: int) -> _Running:
        raise OSError("no more memory")

    with monkeypatch.context() as patch:
        patch.setattr(_Running, "start", refuse)
        kill(processes)
        for _ in range(3):
            with pytest.raises(ProcessEndedError, match="cannot be started: no more memory"):
                remote.detect(SCENE)
        assert processes.numbers == []
    assert_same(remote.detect(SCENE), here.detect(SCENE))


def test_the_end_in_the_middle_of_a_detection() -> None:
    before = descriptors()
    made = DetectionProcesses(2)
    remote, numbers = made.detector("random", "cpu", 0, CONFIG), made.numbers
    for number in numbers:
        os.kill(number, signal.SIGSTOP)
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(remote.detect, SCENE)
        time.sleep(0.05)
        made.end()
        with pytest.raises(ProcessEndedError, match="was ended: signal SIGKILL"):
            asked.result(timeout=60)
    with pytest.raises(ProcessEndedError, match="have been ended"):
        remote.detect(SCENE)
    assert made.numbers == [] and not any(alive(number) for number in numbers)
    made.end()
    assert descriptors() == before


def test_a_process_ends_when_nobody_is_there_to_ask() -> None:
    script = """
import os
from regnet_core.detector import DetectorConfig
from regnet_ros.detection_process import DetectionProcesses
made = DetectionProcesses(2)
made.detector("random", "cpu", 0, DetectorConfig())
print(*made.numbers, flush=True)
os.kill(os.getpid(), 9)
"""
    done = subprocess.run([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, timeout=120)
    numbers = [int(word) for word in done.stdout.split()]
    assert len(numbers) == 2
    wait_until(lambda: not any(alive(number) for number in numbers))
