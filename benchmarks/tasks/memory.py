"""The task of detecting many times, with a look at the memory now and then."""

from __future__ import annotations

import time
from typing import Any

from benchmarks.clouds import read_cloud
from benchmarks.machine import peak_bytes, resident_bytes
from benchmarks.tasks.subject import Prepared, Subject
from regnet_core.gripper import Gripper


class MemoryTask:
    """Detections in a row, with the memory in use after each of some."""

    def __init__(
        self, model: str, weights_seed: int, precision: str, widths: list[float], clouds: list[str], points: int
    ) -> None:
        self._subject = Subject(model, weights_seed, precision, widths[0])
        self._grippers = [Gripper(width=width) for width in widths]
        self._clouds = [Prepared(read_cloud(text), points) for text in clouds]
        self._done = 0

    def facts(self) -> dict[str, Any]:
        """Nothing that the parent does not know."""
        return {}

    def measure(self, detections: int) -> dict[str, Any]:
        """Detect so many times more, in turn on every cloud for every gripper."""
        start = time.perf_counter()
        for _ in range(detections):
            prepared = self._clouds[self._done % len(self._clouds)]
            gripper = self._grippers[self._done // len(self._clouds) % len(self._grippers)]
            self._subject.detect(prepared.result, gripper)
            self._done += 1
        return {
            "done": self._done,
            "resident": resident_bytes(),
            "peak": peak_bytes(),
            "seconds": time.perf_counter() - start,
        }
