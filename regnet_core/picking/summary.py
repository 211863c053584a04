"""Success rate, completion rate and classes of failure over episodes, with their standard errors."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from regnet_core.evaluation.summary import Estimate, estimate
from regnet_core.picking.failures import Failure
from regnet_core.picking.records import Record

FAILURES = tuple(failure.value for failure in Failure)
ALL = "all"
"""The camera of a summary of all cameras."""


@dataclass(frozen=True)
class PickSummary:
    """Some episodes that have scene, model and policy in common."""

    scene: str
    model: str
    policy: str
    camera: str
    """ALL: all cameras together."""
    episodes: int
    objects: int
    """N, summed over the episodes."""
    attempts: int
    successes: int
    """Attempts that placed exactly one object."""
    placed: int
    """Objects in the place bin at the end, those of failed attempts included."""
    success_rate: Estimate
    """SR: successes over attempts; NaN without attempts."""
    completion_rate: Estimate
    """CR: placed over N; the declutter rate of VGN."""
    untouched: float
    """Share of the attempts that succeeded and touched nothing before closing; NaN without attempts."""
    failures: Mapping[str, int]
    """How often each class of failure occurred; all classes are there."""
    ends: Mapping[str, int]
    """How often episodes ended for which reason, the most frequent first."""
    detection_seconds: float
    """Mean time of a detection [s]; NaN without attempts."""


def summarise(records: Sequence[Record]) -> list[PickSummary]:
    """Of each cell, in the order in which they first come; after those of several cameras, all of these together."""
    summaries = []
    for own in _groups(records, ("scene", "model", "policy")):
        cells = _groups(own, ("camera",))
        summaries += [_summary(cell, str(cell[0]["cell"]["camera"])) for cell in cells]
        if len(cells) > 1:
            summaries.append(_summary(own, ALL))
    return summaries


def summary_record(summary: PickSummary) -> dict[str, Any]:
    """As JSON has it; NaN is null."""
    return {
        "scene": summary.scene,
        "model": summary.model,
        "policy": summary.policy,
        "camera": summary.camera,
        "episodes": summary.episodes,
        "objects": summary.objects,
        "attempts": summary.attempts,
        "successes": summary.successes,
        "placed": summary.placed,
        "success_rate": _numbers(summary.success_rate),
        "completion_rate": _numbers(summary.completion_rate),
        "untouched": _number(summary.untouched),
        "failures": dict(summary.failures),
        "ends": dict(summary.ends),
        "detection_seconds": _number(summary.detection_seconds),
    }


def _groups(records: Sequence[Record], names: Sequence[str]) -> list[list[Record]]:
    groups: dict[Hashable, list[Record]] = {}
    for record in records:
        groups.setdefault(tuple(record["cell"][name] for name in names), []).append(record)
    return list(groups.values())


def _summary(own: Sequence[Record], camera: str) -> PickSummary:
    cell = own[0]["cell"]
    # Episodes of the same number have the same scene, whatever the camera: their results hang together.
    owners = [record["episode"] for record in own for _ in record["attempts"]]
    attempts = [attempt for record in own for attempt in record["attempts"]]
    success = [attempt["failure"] is None for attempt in attempts]
    placed = [sum(len(attempt["placed"]) for attempt in record["attempts"]) for record in own]
    counts = Counter(attempt["failure"] for attempt in attempts)
    untouched = [attempt["failure"] is None and attempt["contact"] is None for attempt in attempts]
    return PickSummary(
        scene=cell["scene"],
        model=cell["model"],
        policy=cell["policy"],
        camera=camera,
        episodes=len(own),
        objects=sum(len(record["objects"]) for record in own),
        attempts=len(attempts),
        successes=sum(success),
        placed=sum(placed),
        success_rate=estimate(success, owners),
        completion_rate=estimate(
            [count / len(record["objects"]) for count, record in zip(placed, own, strict=True)],
            [record["episode"] for record in own],
        ),
        untouched=_mean(untouched),
        failures={name: counts[name] for name in FAILURES},
        ends=dict(Counter(record["end"] for record in own).most_common()),
        detection_seconds=_mean([attempt["detection_seconds"] for attempt in attempts]),
    )


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def _numbers(value: Estimate) -> dict[str, float | None]:
    return {name: _number(number) for name, number in value._asdict().items()}


def _number(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None
