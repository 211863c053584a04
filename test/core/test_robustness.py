"""Values of the wrong type or range: always an InvalidInputError that names the value, no accident later on."""

import math
import warnings
from collections.abc import Callable

import numpy as np
import pytest

from regnet_core import AnalyticPolicy, Box, GraspFilters, Grasps, Gripper, InvalidInputError, SelectionLimits
from regnet_core.checks import as_vector, is_number, is_whole
from regnet_core.geometry import transform_points
from regnet_core.preprocessing import PreprocessingConfig

NUMBERS = ["a", None, math.nan, [0.5], True, 1j]
VECTORS = [
    "abc",
    None,
    ("a", "b", "c"),
    (1, 2),
    (1, 2, math.nan),
    (1, (2, 3), 4),
    5,
    (None, None, None),
    ("1", "2", "3"),
]

TABLE: list[tuple[Callable[..., object], str, list[object]]] = [
    (Gripper, "width", NUMBERS),
    (Gripper, "palm_depth", NUMBERS),
    (GraspFilters, "approach_max_angle", NUMBERS),
    (GraspFilters, "approach_axis", [*VECTORS, (0, 0, 0), (1e200, 0, 0)]),
    (GraspFilters, "min_quality", [*NUMBERS, 2, -0.1, math.inf, 10**400]),
    (GraspFilters, "workspace", ["x", 3.0, ((0, 0, 0), (1, 1, 1))]),
    (SelectionLimits, "approach_max_angle", NUMBERS),
    (SelectionLimits, "approach_axis", VECTORS),
    (SelectionLimits, "reach_min", [*NUMBERS, -1, math.inf]),
    (SelectionLimits, "reach_max", [*NUMBERS, 0]),
    (SelectionLimits, "reach_centre", VECTORS),
    (SelectionLimits, "workspace", ["x", 3.0]),
    (AnalyticPolicy, "slope", [*NUMBERS, math.inf]),
    (PreprocessingConfig, "voxel_size", [*NUMBERS, -1, math.inf]),
    (PreprocessingConfig, "max_points", [*NUMBERS, -1, 1.5]),
    (PreprocessingConfig, "seed", [*NUMBERS, -1, 1.5]),
    (PreprocessingConfig, "workspace", ["x", 3.0]),
]
WRONG = [
    pytest.param(kind, name, value, id=f"{kind.__name__}-{name}-{i}")
    for kind, name, values in TABLE
    for i, value in enumerate(values)
]


@pytest.mark.parametrize(("kind", "name", "value"), WRONG)
def test_a_wrong_value_is_refused_by_the_name_of_its_field(kind, name, value):
    with pytest.raises(InvalidInputError, match=name.split("_")[0]):
        kind(**{name: value})


@pytest.mark.parametrize("corner", VECTORS)
def test_a_corner_that_is_no_point_is_refused(corner):
    with pytest.raises(InvalidInputError, match="a box needs"):
        Box((0, 0, 0), corner)
    with pytest.raises(InvalidInputError, match="a box needs"):
        Box(corner, (9, 9, 9))


def test_numbers_of_numpy_are_as_good_as_those_of_python():
    assert all(is_number(v) for v in (1, 0.5, np.float32(1), np.int64(1), np.uint8(1), math.inf))
    assert not any(is_number(v) for v in (True, np.bool_(True), math.nan, np.float32("nan"), "1", None, np.ones(1)))
    assert all(is_whole(v) for v in (0, -1, np.int64(3))) and not any(is_whole(v) for v in (True, 1.0, "1"))
    limits = GraspFilters(
        approach_max_angle=np.float32(1.0), min_quality=np.int64(1), approach_axis=np.array([0, 0, -1])
    )
    assert limits.min_quality == 1
    assert as_vector("v", (1, 2, 3)).tolist() == [1.0, 2.0, 3.0]


def test_a_box_contains_whole_numbers_by_their_value():
    box = Box((0.5, 0.5, 0.5), (1.5, 1.5, 1.5))
    points = [[0, 0, 0], [1, 1, 1], [2, 1, 1]]
    for dtype in (np.int64, np.int8, np.uint8, np.float32, np.float64):
        assert box.contains(np.array(points, dtype)).tolist() == [False, True, False], dtype
    below = Box((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
    assert below.contains(np.array([[0, 1, 1], [0, 0, 2]], np.uint8)).tolist() == [True, False]


def test_a_float32_point_on_a_face_is_inside():
    assert Box((0.1, 0.1, 0.1), (0.7, 0.7, 0.7)).contains(np.full((1, 3), 0.7, np.float32))[0]
    assert Box((0.1, 0.1, 0.1), (0.7, 0.7, 0.7)).contains(np.full((1, 3), 0.1, np.float32))[0]


def test_filters_with_and_without_a_target_are_not_equal():
    box = Box((0, 0, 0), (1, 1, 1))
    assert GraspFilters(target=box) != GraspFilters()
    mask = GraspFilters(target=np.ones(5, bool))
    assert mask == mask and mask != GraspFilters(target=np.zeros(5, bool))
    assert len({GraspFilters(target=box), GraspFilters(), mask}) == 3


def test_points_at_infinity_are_moved_without_a_warning():
    turn = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        moved = transform_points(turn, np.array([[np.inf, 1, 1], [1, 2, 3]]))
    assert not np.isfinite(moved[0]).all()
    assert moved[1].tolist() == [-2.0, 1.0, 3.0]


@pytest.mark.parametrize("transform", [np.eye(3), np.full((4, 4), np.nan), "x", None])
def test_a_transform_that_is_none_is_refused_everywhere(transform):
    for use in (lambda t: transform_points(t, np.zeros((2, 3))), Grasps.empty().transformed, Grasps.empty().tool_poses):
        with pytest.raises(InvalidInputError, match="must"):
            use(transform)
