"""The gripper's bodies against dimensions worked out by hand."""

import math
from fractions import Fraction

import numpy as np
import pytest

from regnet_core import Gripper, GripperError


def test_bodies_of_the_default_gripper() -> None:
    palm, left, right = Gripper(width=0.08).bodies()
    assert np.allclose([palm.lower, palm.upper], [(-0.06, -0.05, -0.005), (0.0, 0.05, 0.005)])
    assert np.allclose([left.lower, left.upper], [(0.0, 0.04, -0.005), (0.06, 0.05, 0.005)])
    assert np.allclose([right.lower, right.upper], [(0.0, -0.05, -0.005), (0.06, -0.04, 0.005)])


def test_fingers_follow_the_opening_and_the_palm_does_not() -> None:
    palm, left, right = Gripper(width=0.08).bodies(opening=0.02)
    assert palm.upper[1] == pytest.approx(0.05)
    assert (left.lower[1], left.upper[1]) == pytest.approx((0.01, 0.02))
    assert (right.lower[1], right.upper[1]) == pytest.approx((-0.02, -0.01))


def test_closing_region_lies_between_the_fingers() -> None:
    region = Gripper(width=0.06).closing_region()
    assert np.allclose([region.lower, region.upper], [(0.0, -0.03, -0.005), (0.06, 0.03, 0.005)])


@pytest.mark.parametrize(
    ("field", "value"),
    [("width", 0.5), ("width", 0.01), ("width", math.nan), ("width", True), ("depth", -1.0), ("height", math.inf)],
)
def test_impossible_dimensions_are_refused_with_the_range(field: str, value: float) -> None:
    low, high = Gripper.LIMITS[field]
    with pytest.raises(GripperError, match=rf"{field} must be .*\[{low}, {high}\]"):
        Gripper().replace(**{field: value})


@pytest.mark.parametrize("opening", [0.0, -0.01, 0.09])
def test_an_opening_beyond_the_width_is_refused(opening: float) -> None:
    with pytest.raises(GripperError, match="opening must be in"):
        Gripper(width=0.08).bodies(opening)


@pytest.mark.parametrize("value", [np.float32(0.08), np.float64(0.08), Fraction(8, 100)])
def test_numbers_of_any_type_are_dimensions(value: float) -> None:
    assert Gripper(width=value).width == pytest.approx(0.08)
    assert type(Gripper(width=value).width) is float


def test_whole_numbers_of_numpy_are_dimensions_where_the_range_has_one() -> None:
    with pytest.raises(GripperError, match=r"must be in .* got 1"):
        Gripper(width=np.int64(1))
    assert Gripper(width=0.08).closing_region(np.float32(0.05)).upper[1] == pytest.approx(0.025)
