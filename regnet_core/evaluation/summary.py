"""Means of a study's results, with their standard errors over scenes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.evaluation.execution import HELD
from regnet_core.evaluation.metrics import MeanMetrics, mean_metrics
from regnet_core.evaluation.study import Times, ViewResult

SHARES = ("cfr", "antipodal", "antipodal_with_collisions", "coverage", "coverage_free")
"""The metrics that are means of shares and scores in [0, 1]."""


class Estimate(NamedTuple):
    """A mean, and how far it may be from that over all scenes there could be."""

    mean: float
    """NaN without values."""
    error: float
    """Standard error; NaN with fewer than two scenes."""


@dataclass(frozen=True)
class Held:
    """What came of the best grasps in physics."""

    tried: int
    """Detections that count: those with a grasp or a label."""
    rate: Estimate
    """Share of them that was held."""
    outcomes: Mapping[str, int]
    """How often each outcome occurred, the most frequent first."""


@dataclass(frozen=True)
class Summary:
    """One method over some of the results."""

    model: str
    width: float | None
    """Of the gripper [m]; None: all widths together."""
    kind: str | None
    """Of the scenes; None: all kinds together."""
    scenes: int
    """How many scenes there are; ``means.scenes`` counts results, of which a scene may have several."""
    means: MeanMetrics
    errors: Mapping[str, float]
    """Standard errors of SHARES over scenes."""
    spread: Mapping[str, float]
    """Standard deviations of the means of SHARES of each seed; NaN with a single seed."""
    times: Times
    """Means [s]."""
    held: Held | None
    """None where nothing was executed."""


def summarise(results: Sequence[ViewResult]) -> list[Summary]:
    """For each method: all results together, then those of each width, then those of each kind of scene."""
    every = [_summary(own, None, None) for own in _groups(results, lambda r: r.model)]
    by_width = [
        _summary(own, own[0].metrics.width, None) for own in _groups(results, lambda r: (r.model, r.metrics.width))
    ]
    by_kind = [_summary(own, None, own[0].kind) for own in _groups(results, lambda r: (r.model, r.kind))]
    return [*every, *by_width, *by_kind]


def estimate(values: npt.ArrayLike, scenes: npt.ArrayLike) -> Estimate:
    """The mean of values (N,), NaN left out, and its standard error where values of one scene (N,) hang together.

    Deviations from the mean are added up in each scene before they are squared: with one value for each scene it is
    the standard deviation over the root of their number.
    """
    x, owner = np.asarray(values, np.float64), np.asarray(scenes)
    there = ~np.isnan(x)
    x, owner = x[there], owner[there]
    if len(x) == 0:
        return Estimate(math.nan, math.nan)
    mean = float(x.mean())
    numbers, row = np.unique(owner, return_inverse=True)
    n = len(numbers)
    if n < 2:
        return Estimate(mean, math.nan)
    together = np.bincount(row, weights=x - mean)
    return Estimate(mean, float(math.sqrt(n / (n - 1) * (together**2).sum()) / len(x)))


def _groups(results: Sequence[ViewResult], key: Callable[[ViewResult], Hashable]) -> list[list[ViewResult]]:
    """The results by their key, in the order in which the keys first come."""
    groups: dict[Hashable, list[ViewResult]] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    return list(groups.values())


def _summary(own: Sequence[ViewResult], width: float | None, kind: str | None) -> Summary:
    scenes = [result.scene for result in own]
    times = np.array([result.times for result in own]).mean(axis=0)
    return Summary(
        model=own[0].model,
        width=width,
        kind=kind,
        scenes=len(set(scenes)),
        means=mean_metrics(result.metrics for result in own),
        errors={name: estimate([getattr(result.metrics, name) for result in own], scenes).error for name in SHARES},
        spread={name: _spread(own, name) for name in SHARES},
        times=Times(*times.tolist()),
        held=_held(own),
    )


def spread_over_seeds(values: npt.ArrayLike, seeds: npt.ArrayLike) -> float:
    """Standard deviation of the means of values (N,), NaN left out, of each seed (N,); NaN with a single seed."""
    x, owner = np.asarray(values, np.float64), np.asarray(seeds)
    there = ~np.isnan(x)
    means = [x[there & (owner == seed)].mean() for seed in np.unique(owner[there])]
    return float(np.std(means, ddof=1)) if len(means) > 1 else math.nan


def _spread(own: Sequence[ViewResult], name: str) -> float:
    return spread_over_seeds([getattr(result.metrics, name) for result in own], [result.seed for result in own])


def _held(own: Sequence[ViewResult]) -> Held | None:
    tried = [result for result in own if result.outcome is not None]
    if not tried:
        return None
    counts = Counter(result.outcome for result in tried if result.outcome is not None)
    rate = estimate([result.outcome == HELD for result in tried], [result.scene for result in tried])
    return Held(len(tried), rate, dict(counts.most_common()))
