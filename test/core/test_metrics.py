"""CFR, AS, AS(w/ C) and TCR on a brick and grasps whose answers are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from regnet_core.data.labels.scene_labels import GraspLabels
from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.evaluation.metrics import (
    MetricConfig,
    SceneMetrics,
    covered,
    evaluate_scene,
    mean_by_width,
    mean_metrics,
)
from regnet_core.geometry import Box, Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper

GRIPPER = Gripper(width=0.08)
DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Columns: approach -z, closing +y, their cross product +x."""
TABLE = Box((-0.5, -0.5, -0.05), (0.5, 0.5, 0.0))
NOTHING = np.zeros((0, 3))

GOOD = (0.0, 0.0, 0.08)
"""Free, and both pads on opposite faces: s_q = 1."""
DEEP = (0.0, 0.0, 0.055)
"""The palm is 5 mm inside the brick's top and the tips 5 mm under the table; the pads still find the faces."""
EMPTY = (0.3, 0.3, 0.08)
"""Free, and nothing between the fingers."""


@pytest.fixture(scope="module")
def truth() -> GroundTruth:
    """A brick on z = 0, 0.04 m wide in y, 0.06 m high."""
    brick = trimesh.creation.box(extents=(0.05, 0.04, 0.06))
    brick.apply_translation((0.0, 0.0, 0.03))
    return GroundTruth([brick], TABLE)


def grasps(*centres: tuple[float, float, float], quality: list[float] | None = None) -> Grasps:
    m = len(centres)
    score = np.linspace(1.0, 0.5, m) if quality is None else np.array(quality)
    return Grasps.from_poses(np.tile(DOWN, (m, 1, 1)), np.array(centres).reshape(m, 3), np.full(m, 0.08), score)


def labels(*centres: tuple[float, float, float]) -> GraspLabels:
    m = len(centres)
    return GraspLabels(
        np.array(centres).reshape(m, 3), np.tile(DOWN, (m, 1, 1)), np.ones(m), np.zeros((m, 2)), np.zeros(m),
        np.zeros(m, np.int64),
    )  # fmt: skip


def test_shares_and_means(truth: GroundTruth) -> None:
    """Four grasps: two good ones, one that collides with s_q = 1, and one in the air with s_q = 0."""
    found = grasps(GOOD, DEEP, EMPTY, (0.0, 0.001, 0.08))
    result = evaluate_scene(found, GRIPPER, NOTHING, truth, labels(GOOD))
    assert (result.proposed, result.checked, result.free, result.kept, result.labels) == (4, 4, 4, 4, 1)
    assert result.cfr == 0.75
    assert result.antipodal == pytest.approx(0.75, abs=1e-6)
    assert result.antipodal_with_collisions == pytest.approx(0.5, abs=1e-6)
    assert result.coverage == 1.0
    assert result.width == 0.08


def test_grasps_that_hit_the_observed_cloud_are_not_kept(truth: GroundTruth) -> None:
    in_finger = np.array([0.0, 0.045, 0.05]) + np.random.default_rng(0).normal(0, 0.001, (20, 3))
    result = evaluate_scene(grasps(GOOD, EMPTY), GRIPPER, in_finger, truth, labels(GOOD, EMPTY))
    assert (result.checked, result.free, result.kept) == (2, 1, 1)
    assert result.cfr == 1.0 and result.antipodal == 0.0
    assert result.coverage == 0.5  # the good label is 0.4 m from the only one kept


def test_grasps_below_the_support_plane_are_not_kept_where_it_is_known(truth: GroundTruth) -> None:
    plane = Plane((0.0, 0.0, 1.0), 0.0)
    assert evaluate_scene(grasps(DEEP), GRIPPER, NOTHING, truth, labels(GOOD)).kept == 1
    assert evaluate_scene(grasps(DEEP), GRIPPER, NOTHING, truth, labels(GOOD), plane=plane).kept == 0


def test_the_best_are_checked_and_the_best_of_the_free_are_kept(truth: GroundTruth) -> None:
    """Ten grasps in the wrong order; five are checked, three kept."""
    quality = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
    centres = [EMPTY] * 5 + [DEEP, EMPTY, DEEP, GOOD, GOOD]
    config = MetricConfig(checked=5, kept=3)
    result = evaluate_scene(
        grasps(*centres, quality=quality), GRIPPER, NOTHING, truth, labels(GOOD, EMPTY), config=config
    )
    assert (result.proposed, result.checked, result.free, result.kept) == (10, 5, 5, 3)
    assert result.cfr == pytest.approx(2 / 3)  # good, good, deep
    assert result.antipodal == pytest.approx(1.0, abs=1e-6)
    assert result.antipodal_with_collisions == pytest.approx(2 / 3, abs=1e-6)
    assert result.coverage == 0.5 and result.coverage_free == 1.0


def test_the_papers_numbers_are_the_default() -> None:
    assert (MetricConfig().checked, MetricConfig().kept, MetricConfig().covered) == (1000, 100, 0.02)


def test_each_grasp_is_judged_at_its_own_opening(truth: GroundTruth) -> None:
    """Open by 0.035 m the fingers stand inside the brick, which is 0.04 m wide."""
    narrow = replace(grasps(GOOD), width=np.array([0.035]))
    result = evaluate_scene(narrow, GRIPPER, NOTHING, truth, labels(GOOD))
    assert result.cfr == 0.0 and result.antipodal == 0.0


def test_coverage_is_within_two_centimetres() -> None:
    wanted = [(0.0, 0.0, 0.0), (0.0, 0.0199, 0.0), (0.0201, 0.0, 0.0), (1.0, 0.0, 0.0)]
    assert covered(wanted, [(0.0, 0.0, 0.0), (1.0, 0.01, 0.0)], 0.02).tolist() == [True, True, False, True]
    assert covered(wanted, NOTHING, 0.02).tolist() == [False] * 4
    assert covered(NOTHING, wanted, 0.02).shape == (0,)


def test_a_scene_without_kept_grasps_counts_zero(truth: GroundTruth) -> None:
    result = evaluate_scene(Grasps.empty(), GRIPPER, NOTHING, truth, labels(GOOD))
    assert (result.cfr, result.antipodal, result.antipodal_with_collisions, result.coverage) == (0.0, 0.0, 0.0, 0.0)
    mean = mean_metrics([result, evaluate_scene(grasps(GOOD), GRIPPER, NOTHING, truth, labels(GOOD))])
    assert (mean.scenes, mean.without_grasps, mean.cfr, mean.coverage) == (2, 1, 0.5, 0.5)


def test_a_scene_with_nothing_to_find_is_left_out(truth: GroundTruth) -> None:
    right = evaluate_scene(Grasps.empty(), GRIPPER, NOTHING, truth, labels())
    assert math.isnan(right.cfr) and math.isnan(right.coverage)
    wrong = evaluate_scene(grasps(DEEP), GRIPPER, NOTHING, truth, labels())
    assert wrong.cfr == 0.0 and math.isnan(wrong.coverage)
    mean = mean_metrics([right, evaluate_scene(grasps(GOOD), GRIPPER, NOTHING, truth, labels(GOOD))])
    assert (mean.scenes, mean.without_grasps, mean.cfr, mean.coverage) == (2, 0, 1.0, 1.0)


def test_means_over_scenes_and_widths() -> None:
    def result(width: float, cfr: float, coverage: float) -> SceneMetrics:
        return SceneMetrics(width, 9, 9, 9, 9, 5, cfr, cfr / 2, cfr / 4, coverage, coverage)

    rows = [result(0.08, 1.0, 0.2), result(0.06, 0.5, 0.4), result(0.08, 0.6, math.nan)]
    whole = mean_metrics(rows)
    assert whole.cfr == pytest.approx(0.7) and whole.antipodal == pytest.approx(0.35)
    assert whole.antipodal_with_collisions == pytest.approx(0.175)
    assert whole.coverage == pytest.approx(0.3) and whole.kept == 9
    own = mean_by_width(rows)
    assert list(own) == [0.06, 0.08]
    assert own[0.08].cfr == pytest.approx(0.8) and own[0.08].coverage == pytest.approx(0.2) and own[0.06].scenes == 1


def test_means_of_nothing_are_unknown() -> None:
    assert math.isnan(mean_metrics([]).cfr) and mean_metrics([]).scenes == 0 and mean_by_width([]) == {}


@pytest.mark.parametrize("wrong", [{"kept": 0}, {"checked": 0}, {"covered": -0.01}])
def test_impossible_numbers_are_refused(wrong: dict) -> None:
    with pytest.raises(InvalidInputError):
        MetricConfig(**wrong)
