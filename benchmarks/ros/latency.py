"""From the publication of a cloud to the arrival of its grasps, one cloud at a time."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.clouds import GivenCloud, read_cloud
from benchmarks.errors import BenchmarkError
from benchmarks.machine import LoadMeter
from benchmarks.models import ModelChoice, choose_model, ready_model
from benchmarks.records import LatencyRecord
from benchmarks.ros.system import NAMESPACE, NodeSystem, check_ros, ros_environment
from benchmarks.summary import Summary
from benchmarks.workers import Worker
from regnet_core.checks import check_range

_ANSWER_WITHIN = 60.0
_LARGE_CLOUDS = Path(__file__).parents[2] / "config" / "fastdds_large_clouds.xml"
"""README.md tells users to start their camera's driver with it."""
BEFORE = ("preprocessor convert", "preprocessor prepare", "preprocessor publish", "detector convert")
"""What the nodes do before the detection begins; what follows it is not waited for by the first publication."""


@dataclass(frozen=True)
class LatencySettings:
    """What to measure.

    Raises:
        InvalidInputError: a number is out of range.
    """

    model: str
    """As ``choose_model`` takes it."""
    cloud: str = "bags/tilted_depth_only"
    """As ``read_cloud`` takes it."""
    threads: int = 2
    """The detector's parameter; 0: one for each core."""
    clouds: int = 50
    warm_up: int = 5
    """Clouds that do not count."""
    pause: float = 0.2
    """From an answer to the next cloud [s]."""
    width: float = 0.08
    """Of the gripper [m]."""
    weights_seed: int = 0

    def __post_init__(self) -> None:
        check_range("clouds", self.clouds, 1)
        check_range("warm_up", self.warm_up, 0)
        check_range("pause", self.pause, 0.0, 60.0, "s")
        check_range("threads", self.threads, 0, 1024)


@dataclass(frozen=True)
class _Answer:
    """What one cloud took [s]."""

    latency: float
    detection: float
    proposals: float
    grasps: int


def measure_latency(settings: LatencySettings, say: Callable[[str], None] = print) -> LatencyRecord:
    """Start the nodes, publish clouds, and see when the results arrive.

    Raises:
        BenchmarkError: there is no ROS, a node does not start, or a result does not come.
    """
    check_ros()
    choice, given = choose_model(settings.model, settings.weights_seed), read_cloud(settings.cloud)
    say(f"end to end: {choice.name} on {given.name}")
    with ExitStack() as stack:
        environment = stack.enter_context(ros_environment())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        model = ready_model(choice, folder, settings.weights_seed)
        system = NodeSystem(stack, environment, model, settings.threads, settings.width, given.T_target_cloud)
        where = {"cloud": settings.cloud, "topic": f"{NAMESPACE}/points"}
        camera = {**environment, "FASTRTPS_DEFAULT_PROFILES_FILE": str(_LARGE_CLOUDS)}
        publisher = stack.enter_context(Worker("publisher", 1, where, camera))
        system.wait_until(lambda: publisher.ask("subscribers")["count"] > 0, "the preprocessor to listen")
        for number in range(settings.warm_up):
            _one(publisher, system, number, settings.pause)
        system.receiver.ask("diagnostics")
        meter = LoadMeter([publisher.pid, *system.pids])
        answers = [
            _one(publisher, system, settings.warm_up + number, settings.pause) for number in range(settings.clouds)
        ]
        others = meter.others()
        # One more look at what the nodes say of themselves, which they do once a second.
        heard = _diagnosed(system)
        return _record(settings, choice, given, publisher.facts["bytes"], answers, heard, others)


def node_latencies(status: Sequence[Mapping[str, Any]]) -> dict[str, list[float]]:
    """The times in statuses of the nodes, by "node stage" [s]."""
    found: dict[str, list[float]] = {}
    for one in status:
        for key, value in one["values"].items():
            if key.startswith("latency ") and key.endswith(" [ms]"):
                name = f"{one['node']} {key.removeprefix('latency ').removesuffix(' [ms]')}"
                found.setdefault(name, []).append(float(value) / 1e3)
    return found


def _one(publisher: Worker, system: NodeSystem, number: int, pause: float) -> _Answer:
    sent = publisher.ask(number=number)["sent"]
    answer = system.receiver.ask(number=number, patience=_ANSWER_WITHIN)
    if "proposals" not in answer["steps"]:
        raise BenchmarkError(f"the detector had nothing to detect grasps on: {answer['reason']}")
    time.sleep(pause)
    return _Answer(
        (answer["arrived"] - sent) / 1e9, answer["total"], answer["steps"]["proposals"], int(answer["grasps"])
    )


def _diagnosed(system: NodeSystem) -> dict[str, list[float]]:
    heard: list[dict[str, Any]] = []

    def complete() -> bool:
        heard.extend(system.receiver.ask("diagnostics")["status"])
        return set(BEFORE) <= set(node_latencies(heard))

    system.wait_until(complete, "diagnostics of the nodes")
    return node_latencies(heard)


def _record(
    settings: LatencySettings,
    choice: ModelChoice,
    given: GivenCloud,
    nbytes: int,
    answers: Sequence[_Answer],
    heard: Mapping[str, Sequence[float]],
    others: float,
) -> LatencyRecord:
    before = sum(median(heard[name]) for name in BEFORE)
    latencies = [answer.latency for answer in answers]
    return LatencyRecord(
        model=choice.name,
        weights=choice.weights,
        threads=settings.threads,
        cloud=given.name,
        points=len(given.points),
        message_bytes=nbytes,
        grasps=round(median(answer.grasps for answer in answers)),
        clouds=len(answers),
        total=Summary.of(latencies),
        slowest=float(np.quantile(latencies, 0.95)),
        proposals=Summary.of([answer.proposals for answer in answers]),
        outside=Summary.of([answer.latency - answer.proposals for answer in answers]),
        detection=Summary.of([answer.detection for answer in answers]),
        parts={name: Summary.of(values) for name, values in heard.items()},
        transport=Summary.of([answer.latency - answer.detection - before for answer in answers]),
        others=others,
    )
