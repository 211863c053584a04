"""What a detection did: the grasps that each step kept and rejected, the time of each step, why there is none."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(frozen=True)
class StepReport:
    """One step of a detection."""

    name: str
    kept: int
    """How many items (points before the proposals, grasps from then on) left the step."""
    rejected: int
    """How many items the step refused."""
    seconds: float


@dataclass(frozen=True)
class DetectionReport:
    """All steps of one detection in their order."""

    steps: tuple[StepReport, ...]
    model: str
    device: str
    reason: str = ""
    """Why there is no grasp, in a sentence; empty when there are some."""
    total_seconds: float = 0.0
    warnings: tuple[str, ...] = ()
    """What makes the result less reliable than usual, a sentence each."""

    def __getitem__(self, name: str) -> StepReport:
        for step in self.steps:
            if step.name == name:
                return step
        raise KeyError(f"no step '{name}'; the steps are {', '.join(s.name for s in self.steps)}")


class Step:
    """Filled in by the code that runs inside ``StepRecorder.step``."""

    def __init__(self) -> None:
        self.kept = 0
        self.rejected = 0


@dataclass
class StepRecorder:
    """Collects the steps of one detection with their times."""

    steps: list[StepReport] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)

    @contextmanager
    def step(self, name: str) -> Iterator[Step]:
        """Time a step; its counts are what the code inside writes to the yielded object."""
        record, start = Step(), time.perf_counter()
        yield record
        self.steps.append(StepReport(name, record.kept, record.rejected, time.perf_counter() - start))

    def finish(self, model: str, device: str, reason: str = "") -> DetectionReport:
        """The report of everything recorded so far."""
        seconds = time.perf_counter() - self.started
        return DetectionReport(tuple(self.steps), model, device, reason, seconds, tuple(self.warnings))
