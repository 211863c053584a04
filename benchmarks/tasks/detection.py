"""The task of measuring detections by one model, in one precision, on so many threads."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict
from importlib.util import find_spec
from typing import Any

from benchmarks.clouds import read_cloud
from benchmarks.errors import BenchmarkError
from benchmarks.machine import peak_bytes
from benchmarks.stages import MESSAGE_STAGES, PREPROCESSOR_STAGES, check_seen, detector_stages
from benchmarks.tasks.subject import Prepared, Subject
from benchmarks.timer import Sample, StageTimer
from benchmarks.work import OBSERVERS
from regnet_core.detector import Detection


class DetectionTask:
    """Every measurement is one cloud through everything, with and without stage timers."""

    def __init__(
        self,
        model: str,
        weights_seed: int,
        precision: str,
        width: float,
        clouds: list[str],
        points: int,
        crop: list[float],
    ) -> None:
        self._subject = Subject(model, weights_seed, precision, width)
        self._clouds = [Prepared(read_cloud(text), points, crop) for text in clouds]
        network = self._subject.network
        stages = detector_stages(type(self._subject.proposer), network is not None)
        self._stages = {"preprocessor": PREPROCESSOR_STAGES, "detector": stages}
        observers = OBSERVERS if network is not None else {}
        self._timers = {
            "preprocessor": StageTimer(PREPROCESSOR_STAGES),
            "detector": StageTimer(stages, self._subject.levels, observers),
        }
        self._paths: list[Any] = []
        if find_spec("rclpy") and find_spec("regnet_msgs"):
            from benchmarks.messages import MessagePath

            self._paths = [MessagePath(prepared.cloud) for prepared in self._clouds]
            self._stages["messages"] = MESSAGE_STAGES
            self._timers["messages"] = StageTimer(MESSAGE_STAGES)

    def facts(self) -> dict[str, Any]:
        """The network's name in the zoo, and what the clouds are."""
        network = self._subject.network
        return {
            "network": "" if network is None else network.name,
            "clouds": [
                {"name": p.cloud.name, "points": len(p.cloud.points), "prepared": len(p.result.points)}
                for p in self._clouds
            ],
        }

    def measure(self, cloud: int, timed_first: bool) -> dict[str, Any]:
        """Two detections, one of them with stage timers, and the stages around them.

        Args:
            cloud: which of the clouds.
            timed_first: whether the one with timers comes first; alternate, so that caches favour neither.

        Raises:
            BenchmarkError: the cloud has nothing to detect grasps on.
            StageError: a stage that should run did not.
        """
        prepared, found = self._clouds[cloud], dict[str, Any]()
        for timed in (timed_first, not timed_first):
            found["timed" if timed else "plain"], detection = self._detect(prepared, timed)
        with self._timers["preprocessor"] as timer:
            result = prepared.preprocess()
            found["preprocessor"] = self._sample("preprocessor", timer)
        if self._paths:
            with self._timers["messages"] as timer:
                self._paths[cloud].run(result, detection)
                found["messages"] = self._sample("messages", timer)
        found["grasps"], found["peak_bytes"] = len(detection.grasps), peak_bytes()
        return found

    def _detect(self, prepared: Prepared, timed: bool) -> tuple[dict[str, Any], Detection]:
        with ExitStack() as stack:
            timer = stack.enter_context(self._timers["detector"]) if timed else None
            wall, cpu = time.perf_counter(), time.process_time()
            detection = self._subject.detect(prepared.result)
            record: dict[str, Any] = {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}
            _check_something_to_do(prepared.cloud.name, detection)
            if timer is not None:
                record.update(self._sample("detector", timer))
        return record, detection

    def _sample(self, part: str, timer: StageTimer) -> dict[str, Any]:
        sample: Sample = timer.take()
        check_seen(self._stages[part], self._subject.network, sample.stages, self._subject.levels)
        return asdict(sample)


def _check_something_to_do(cloud: str, detection: Detection) -> None:
    steps: Mapping[str, Any] = {step.name: step for step in detection.report.steps}
    proposals = steps.get("proposals")
    if proposals is None or proposals.kept + proposals.rejected == 0:
        raise BenchmarkError(
            f"the cloud {cloud} has nothing to detect grasps on: {detection.report.reason or 'no candidate was found'}"
        )
