"""The task of measuring the machine's peaks on so many threads."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from benchmarks.peaks import PeakMeter


class PeakTask:
    """Every measurement is one trial of each peak."""

    def __init__(self, side: int, array_bytes: int | None) -> None:
        self._meter = PeakMeter(side, array_bytes)

    def facts(self) -> dict[str, Any]:
        """How many threads torch has."""
        import torch

        return {"threads": torch.get_num_threads()}

    def measure(self) -> dict[str, Any]:
        """One trial."""
        return asdict(self._meter.measure())
