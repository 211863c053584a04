"""By how much the best method leads, compared with the second best on the same scenes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from regnet_core.evaluation.study import ViewResult
from regnet_core.evaluation.summary import estimate, spread_over_seeds

LEADS = ("cfr", "antipodal", "antipodal_with_collisions", "coverage")
"""The metrics that are compared; larger is better in all of them."""


@dataclass(frozen=True)
class Lead:
    """The two best methods in one metric."""

    metric: str
    """One of LEADS."""
    best: str
    second: str
    difference: float
    """Mean over the results in which both have a value."""
    error: float
    """Standard error over scenes of that difference, scene by scene."""
    spread: float
    """Standard deviation of that difference over seeds; NaN with a single one."""


def leads(results: Sequence[ViewResult]) -> list[Lead]:
    """The lead in each metric; none where there is one method alone."""
    models = list(dict.fromkeys(result.model for result in results))
    if len(models) < 2:
        return []
    own = {model: {_key(result): result for result in results if result.model == model} for model in models}
    found = []
    for metric in LEADS:
        means = {model: _mean(own[model].values(), metric) for model in models}
        best, second = sorted(models, key=lambda m: np.nan_to_num(means[m], nan=-np.inf), reverse=True)[:2]
        pairs = [(result, own[second][key]) for key, result in own[best].items() if key in own[second]]
        difference = [getattr(a.metrics, metric) - getattr(b.metrics, metric) for a, b in pairs]
        lead = estimate(difference, [a.scene for a, _ in pairs])
        spread = spread_over_seeds(difference, [a.seed for a, _ in pairs])
        found.append(Lead(metric, best, second, lead.mean, lead.error, spread))
    return found


def _key(result: ViewResult) -> tuple[int, int, int, float]:
    """What both methods got."""
    return result.seed, result.scene, result.view, result.metrics.width


def _mean(results: Iterable[ViewResult], metric: str) -> float:
    every = list(results)
    return estimate([getattr(r.metrics, metric) for r in every], [r.scene for r in every]).mean
