"""What the project wants to reach, held against a document."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from benchmarks.records import Document, RunRecord
from benchmarks.tables import markdown, speed_ups

_PAPER_POINTS = 25_600
_SENSOR_POINTS = 512 * 424


@dataclass(frozen=True)
class Goal:
    """One number that should be on one side of a limit."""

    what: str
    limit: float
    unit: str
    at_most: bool
    measured: Callable[[Document], float | None]
    """In the unit; None where the document does not say."""

    def reached(self, value: float) -> bool:
        """Whether a value is on the right side."""
        return value <= self.limit if self.at_most else value >= self.limit


def goal_table(document: Document) -> str:
    """What was reached, of all that the document says something about; empty where that is nothing."""
    rows = []
    for goal in GOALS:
        value = goal.measured(document)
        if value is not None:
            wanted = f"{'at most' if goal.at_most else 'at least'} {goal.limit:g} {goal.unit}"
            rows.append([goal.what, wanted, f"{value:.1f}", "yes" if goal.reached(value) else "no"])
    return markdown(["goal", "wanted", "measured", "reached"], rows) if rows else ""


def _detection(document: Document, model: str, seen: int) -> float | None:
    """The fastest way to run a model, on the cloud that it is slowest on [ms]."""
    fastest: dict[str, float] = {}
    for run in document.runs:
        if run.model == model and run.seen >= seen:
            fastest[run.cloud] = min(fastest.get(run.cloud, float("inf")), 1e3 * run.total.median)
    return max(fastest.values(), default=None)


def _speed_up(document: Document, model: str) -> float | None:
    """How much faster the fastest way to run the network is than the plain implementation with as many threads."""
    ratios = [
        speed_ups(plain, run)[0]
        for plain in document.references
        if plain.model == model
        for run in _matching(document.runs, plain.model, plain.threads, plain.cloud)
    ]
    return max(ratios, default=None)


def _matching(runs: Iterable[RunRecord], model: str, threads: int, cloud: str) -> list[RunRecord]:
    return [run for run in runs if (run.model, run.threads, run.cloud) == (model, threads, cloud)]


def _sustained(document: Document, model: str) -> float | None:
    return max((item.sustained for item in document.throughputs if item.model == model), default=None)


def _outside(document: Document) -> float | None:
    times = [1e3 * item.outside.median for item in document.latencies if item.points == _SENSOR_POINTS]
    return min(times, default=None)


def _growth(document: Document) -> float | None:
    return max((item.growth / 1e6 for item in document.memory if item.conclusive), default=None)


GOALS = (
    Goal(
        "`regnetv2`, 25600 points, cloud to ranked grasps", 257.0, "ms", True,
        lambda document: _detection(document, "regnetv2", _PAPER_POINTS),
    ),
    Goal(
        "its network against the plain padded one in fp32", 8.0, "times faster", False,
        lambda document: _speed_up(document, "regnetv2"),
    ),
    Goal(
        "`regnetv2-s`, cloud to ranked grasps", 60.0, "ms", True,
        lambda document: _detection(document, "regnetv2-s", 1),
    ),
    Goal(
        "`regnetv2-s`, a replayed bag through the nodes", 15.0, "clouds/s", False,
        lambda document: _sustained(document, "regnetv2-s"),
    ),
    Goal(
        "all but the model, 512 x 424 points, publication to arrival", 25.0, "ms", True, _outside,
    ),
    Goal(
        "growth of memory in 10,000 detections, after at least as many", 16.8, "MB", True, _growth,
    ),
)  # fmt: skip
"""Each is judged at the number of threads, and in the precision, that is best for it."""
