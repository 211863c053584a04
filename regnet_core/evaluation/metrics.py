"""CFR, AS, AS(w/ C) and TCR of REGNet V2, section "Evaluation Metrics": the same code for every method.

Of a method's grasps, the best CHECKED by its own score are checked against the observed cloud as a robot would
do, and the best KEPT of the free ones are judged on the true scene:
- CFR, the collision-free ratio: the share of them that hits neither an object, the table nor a fixture;
- AS, the antipodal score: the mean of their true s_q;
- AS(w/ C): the same where colliding grasps count 0;
- TCR, the true coverage ratio: the share of the labelled grasps whose centre is within COVERED of a kept one's.

A scene with labelled grasps for which nothing is kept counts 0 in every mean: no method gains by giving up on hard
scenes. A scene without labels and without kept grasps was answered rightly, has nothing to judge, and is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from regnet_core.checks import check_range
from regnet_core.collision import CollisionConfig, SceneCollision
from regnet_core.geometry import Array, Mask, Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper

if TYPE_CHECKING:  # they need fcl, open3d and numba, which who reads a table of metrics does not
    from regnet_core.data.labels.scene_labels import GraspLabels
    from regnet_core.evaluation.ground_truth import GroundTruth


@dataclass(frozen=True)
class MetricConfig:
    """The paper's numbers.

    Raises:
        InvalidInputError: a number is out of range.
    """

    checked: int = 1000
    """Grasps of a method that are checked against the observed cloud, best first."""
    kept: int = 100
    """Grasps that are judged, the best of the free ones."""
    covered: float = 0.02
    """Greatest distance between a labelled grasp's centre and that of a kept one which covers it [m]."""
    collision: CollisionConfig = CollisionConfig()
    """Of the check against the observed cloud."""

    def __post_init__(self) -> None:
        check_range("checked", self.checked, 1, 10**9)
        check_range("kept", self.kept, 1, 10**9)
        check_range("covered", self.covered, 0.0, 1.0, "m")


@dataclass(frozen=True)
class SceneMetrics:
    """One method on one view of a scene with one gripper; shares and scores in [0, 1], NaN where nothing is judged."""

    width: float
    """The gripper's W [m]."""
    proposed: int
    """How many grasps the method gave."""
    checked: int
    """How many of them were checked against the observed cloud."""
    free: int
    """How many of these are free of it."""
    kept: int
    """How many of these were judged."""
    labels: int
    """How many labelled grasps the scene has."""
    cfr: float
    """CFR."""
    antipodal: float
    """AS."""
    antipodal_with_collisions: float
    """AS(w/ C)."""
    coverage: float
    """TCR, of the kept grasps; NaN without labels."""
    coverage_free: float
    """The same of all free ones: what could be reached if more than the best were wanted; NaN without labels."""


@dataclass(frozen=True)
class MeanMetrics:
    """Means over scenes, each leaving out the scenes where it is NaN; NaN when there is none."""

    scenes: int
    """How many results there are."""
    without_grasps: int
    """In how many of them nothing was kept although there are labelled grasps."""
    cfr: float
    antipodal: float
    antipodal_with_collisions: float
    coverage: float
    coverage_free: float
    kept: float
    """Mean number of grasps that were judged."""


class _Judged(NamedTuple):
    cfr: float
    antipodal: float
    antipodal_with_collisions: float


def evaluate_scene(
    grasps: Grasps,
    gripper: Gripper,
    observed: npt.ArrayLike,
    truth: GroundTruth,
    labels: GraspLabels,
    *,
    plane: Plane | None = None,
    config: MetricConfig | None = None,
) -> SceneMetrics:
    """Judge what one method gave for one view.

    Args:
        grasps: in the world frame, in any order; ranked here by ``quality``. Each is checked at its own ``width``.
        gripper: the hand.
        observed: (N, 3) the observed cloud in the world frame, table included [m].
        truth: the judge of the scene.
        labels: the scene's labelled grasps for this gripper.
        plane: the support plane that the method may know as well; grasps that reach below it count as not free.
        config: the paper's numbers unless given.
    """
    cfg = config or MetricConfig()
    candidates = grasps.ranked()[: cfg.checked]
    collision = SceneCollision(np.asarray(observed, np.float64), plane, cfg.collision)
    free = candidates[~(collision.with_points(candidates, gripper) | collision.with_table(candidates, gripper))]
    kept = free[: cfg.kept]
    judged = _judge(kept, gripper, truth, len(labels))
    return SceneMetrics(
        width=gripper.width,
        proposed=len(grasps),
        checked=len(candidates),
        free=len(free),
        kept=len(kept),
        labels=len(labels),
        cfr=judged.cfr,
        antipodal=judged.antipodal,
        antipodal_with_collisions=judged.antipodal_with_collisions,
        coverage=_share(covered(labels.translation, kept.translation, cfg.covered)),
        coverage_free=_share(covered(labels.translation, free.translation, cfg.covered)),
    )


def covered(wanted: npt.ArrayLike, found: npt.ArrayLike, distance: float) -> Mask:
    """(M,) which centres (M, 3) have one of the found centres (K, 3) within the distance [m]."""
    to = np.asarray(wanted, np.float64).reshape(-1, 3)
    tree = cKDTree(np.asarray(found, np.float64).reshape(-1, 3))
    return np.asarray(tree.query(to)[0] <= distance) if tree.n else np.zeros(len(to), np.bool_)


def mean_metrics(results: Iterable[SceneMetrics]) -> MeanMetrics:
    """Means over scenes, views and, when results of several widths are given, widths (the paper's Dataset-All)."""
    rows = list(results)

    def mean(name: str) -> float:
        values = np.array([getattr(row, name) for row in rows], np.float64)
        values = values[~np.isnan(values)]
        return float(values.mean()) if len(values) else math.nan

    return MeanMetrics(
        scenes=len(rows),
        without_grasps=sum(row.kept == 0 and row.labels > 0 for row in rows),
        cfr=mean("cfr"),
        antipodal=mean("antipodal"),
        antipodal_with_collisions=mean("antipodal_with_collisions"),
        coverage=mean("coverage"),
        coverage_free=mean("coverage_free"),
        kept=mean("kept"),
    )


def mean_by_width(results: Iterable[SceneMetrics]) -> dict[float, MeanMetrics]:
    """Means for each gripper width, by rising width [m]."""
    rows = list(results)
    return {width: mean_metrics(r for r in rows if r.width == width) for width in sorted({r.width for r in rows})}


def _judge(kept: Grasps, gripper: Gripper, truth: GroundTruth, labels: int) -> _Judged:
    if len(kept) == 0:
        return _Judged(*((0.0 if labels else math.nan,) * 3))
    clear = ~truth.collides(kept, gripper)
    score: Array = truth.antipodal(kept, gripper).score
    return _Judged(_share(clear), float(score.mean()), float((score * clear).mean()))


def _share(hits: Mask) -> float:
    return float(hits.mean()) if len(hits) else math.nan
