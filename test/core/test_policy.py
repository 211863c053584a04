"""The selection policies against values computed by hand, and the limits of the robot."""

import math
import warnings

import numpy as np
import pytest

from regnet_core import (
    AnalyticPolicy,
    Box,
    Grasps,
    HeuristicPolicy,
    InvalidInputError,
    SelectionLimits,
    make_policy,
    select,
)


def looking(approach: list[list[float]], quality: list[float], at: list[list[float]] | None = None) -> Grasps:
    x = np.array(approach, float)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(x, [0.31, 0.92, 0.23])
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    rotation = np.stack([x, y, np.cross(x, y)], axis=-1)
    return Grasps.from_poses(rotation, np.zeros((len(x), 3)) if at is None else at, [0.05] * len(x), quality)


def test_heuristic_is_the_sum() -> None:
    assert HeuristicPolicy().score(np.array([0.7]), np.array([0.9]))[0] == pytest.approx(1.6)


@pytest.mark.parametrize(
    ("quality", "vertical", "score"),
    [
        (1.0, 0.6103, 0.5 * 0.8196),  # at the midpoint the reach term is one half
        (1.0, 1.0, 0.8196 / (1.0 + math.exp(-3.94538))),
        (0.5, 0.5, 0.38045 / (1.0 + math.exp(1.11672))),
        (0.0, 1.0, -0.0587 / (1.0 + math.exp(-3.94538))),
    ],
)
def test_analytic_by_hand(quality: float, vertical: float, score: float) -> None:
    assert AnalyticPolicy().score(np.array([quality]), np.array([vertical]))[0] == pytest.approx(score, abs=1e-4)


def test_constants_are_parameters() -> None:
    policy = make_policy("analytic", quality_gain=1.0, quality_offset=0.0, slope=0.0, midpoint=0.3)
    assert policy.score(np.array([0.8]), np.array([0.1]))[0] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("name", "constants", "message"),
    [
        ("best", {}, "no policy 'best'; there are heuristic, analytic"),
        ("heuristic", {"slope": 1.0}, "takes the constants none"),
        ("analytic", {"slope": math.nan}, "slope must be a finite number"),
    ],
)
def test_wrong_policies_are_refused(name: str, constants: dict[str, float], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make_policy(name, **constants)


def test_the_policies_disagree_where_they_should() -> None:
    # From the side (s_v = 0.5) with quality 1, or straight down with quality 0.45.
    grasps = looking([[1, 0, 0], [0, 0, -1]], [1.0, 0.45])
    assert select(grasps, HeuristicPolicy()).rank == 0
    assert select(grasps, AnalyticPolicy()).rank == 1


def test_excluded_ranks_fall_to_the_next_and_then_to_none() -> None:
    grasps = looking([[0, 0, -1]] * 3, [0.5, 0.9, 0.7])
    policy = HeuristicPolicy()
    assert select(grasps, policy).rank == 1
    assert select(grasps, policy, excluded=[1]).rank == 2
    assert select(grasps, policy, excluded=[1, 2, 99, -1]).rank == 0
    assert select(grasps, policy, excluded=[0, 1, 2]) is None
    assert select(Grasps.empty(), policy) is None


def test_limits_of_the_robot() -> None:
    grasps = looking([[0, 0, -1], [1, 0, -1], [1, 0, 0]], [0.1, 0.2, 0.3], [[1, 0, 0], [0.5, 0, 0], [0.2, 0, 0]])
    cone = SelectionLimits(approach_max_angle=math.radians(46))
    assert cone.accepts(grasps).tolist() == [True, True, False]
    assert SelectionLimits(reach_min=0.3, reach_max=0.9).accepts(grasps).tolist() == [False, True, False]
    assert SelectionLimits(reach_centre=(1.0, 0, 0), reach_max=0.1).accepts(grasps).tolist() == [True, False, False]
    box = SelectionLimits(workspace=Box((0.4, -1, -1), (0.6, 1, 1)))
    assert box.accepts(grasps).tolist() == [False, True, False]
    assert select(grasps, HeuristicPolicy(), cone).rank == 0


@pytest.mark.parametrize(
    "wrong", [{"reach_min": 2.0, "reach_max": 1.0}, {"approach_max_angle": 0.0}, {"approach_axis": (0, 0, 0)}]
)
def test_limits_without_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError):
        SelectionLimits(**wrong)


def test_a_very_steep_slope_is_a_step_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        score = AnalyticPolicy(quality_gain=1.0, quality_offset=0.0, slope=1e5).score(np.full(2, 0.5), np.array([0, 1]))
    assert score.tolist() == [0.0, 0.5]


def test_a_constant_that_is_no_number_is_not_called_unknown() -> None:
    with pytest.raises(InvalidInputError, match="slope must be a finite number, got 'x'"):
        make_policy("analytic", slope="x")
