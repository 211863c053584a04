"""Points in buckets, and what is asked of 32 points or 16 boxes at a time, against numpy."""

import numpy as np
import pytest
from numba import njit
from scipy.spatial.transform import Rotation

from regnet_core.ops import lanes
from regnet_core.ops.buckets import GROUP, SIZE, Buckets, in_buckets, near_bucket

RNG = np.random.default_rng(0)


def cloud(size: int) -> np.ndarray:
    """Points on a bent sheet, some of them twice."""
    points = RNG.uniform(-0.3, 0.3, (size, 3)).astype(np.float32)
    points[:, 2] = 0.5 + points[:, 0] * points[:, 1]
    points[size // 2 : size // 2 + 5] = points[0]
    return points


@pytest.mark.parametrize("size", [1, 31, 32, 33, 700, 9000])
def test_every_point_is_in_one_bucket_and_in_its_boxes(size: int) -> None:
    points = cloud(size)
    made = in_buckets(points)
    count = -(-size // SIZE)
    assert made.number == size and made.points.shape == (count, 3, SIZE)
    rows = made.rows.reshape(-1)
    np.testing.assert_array_equal(np.sort(rows[:size]), np.arange(size))
    assert (rows[size:] == rows[size - 1]).all()
    np.testing.assert_array_equal(made.points.transpose(0, 2, 1).reshape(-1, 3), points[rows])
    lower, upper = made.points.min(axis=2), made.points.max(axis=2)
    boxes = made.boxes.transpose(0, 2, 1).reshape(-1, 6)
    np.testing.assert_array_equal(boxes[:count], np.concatenate([lower, upper], axis=1))
    assert (boxes[count:, :3] == np.inf).all() and (boxes[count:, 3:] == -np.inf).all()
    groups = made.groups.transpose(0, 2, 1).reshape(-1, 6)
    for g in range(-(-count // GROUP)):
        own = slice(g * GROUP, (g + 1) * GROUP)
        np.testing.assert_array_equal(groups[g], [*lower[own].min(axis=0), *upper[own].max(axis=0)])


def sides(buckets: Buckets) -> np.ndarray:
    """(B, 3)."""
    return buckets.points.max(axis=2) - buckets.points.min(axis=2)


def test_buckets_hold_neighbours() -> None:
    points = cloud(20_000)
    area = np.sort(sides(in_buckets(points)), axis=1)[:, 1:].prod(axis=1)
    assert np.median(area) < 4.0 * 0.36 * SIZE / 20_000  # of as many points anywhere on the sheet


def test_buckets_of_nothing_and_of_equal_points() -> None:
    nothing = in_buckets(np.zeros((0, 3), np.float32))
    assert nothing.number == 0 and len(nothing.rows) == 0 and len(nothing.groups) == 0
    equal = in_buckets(np.full((70, 3), 7.0, np.float32))
    assert sorted(equal.rows.reshape(-1)[:70]) == list(range(70)) and (sides(equal) == 0.0).all()


@njit
def _near(queries, b, points, squared):  # type: ignore[no-untyped-def]
    places = np.empty(points.number, np.int32)
    n = near_bucket(queries, b, points, squared, np.empty(len(points.rows), np.int64), places)
    return places[:n]


@pytest.mark.parametrize("reach", [0.0, 0.01, 0.1, 2.0])
def test_points_near_a_bucket(reach: float) -> None:
    points, queries = in_buckets(cloud(9000)), in_buckets(cloud(300))
    at = points.points.transpose(0, 2, 1).reshape(-1, 3)[: points.number]
    for b in range(len(queries.rows)):
        lower, upper = queries.points[b].min(axis=1), queries.points[b].max(axis=1)
        gaps = np.maximum(np.maximum(lower - at, at - upper), np.float32(0.0))
        expected = np.flatnonzero((gaps * gaps).sum(axis=1) <= np.float32(reach * reach))
        np.testing.assert_array_equal(np.sort(_near(queries, b, points, np.float32(reach * reach))), expected)


def bits(truth: np.ndarray) -> int:
    return sum(1 << int(i) for i in np.flatnonzero(truth))


@njit
def _ball(points, x, y, z, squared):  # type: ignore[no-untyped-def]
    return lanes.in_ball(points.ctypes.data, x, y, z, squared)


@njit
def _sum(sums, values, chosen, weights):  # type: ignore[no-untyped-def]
    places = np.empty(len(chosen), np.int64)
    for n in range(len(chosen)):
        places[n] = values.ctypes.data + 4 * values.shape[1] * chosen[n]
    lanes.weighted_sum(sums.ctypes.data, places.ctypes.data, 8, weights.ctypes.data, len(chosen))
    return places.sum()  # so that they are there until now


@pytest.mark.parametrize("chosen", [[], [4], [3, 0, 3, 1]])
def test_sums_are_rounded_as_one_by_one(chosen: list[int]) -> None:
    values, weights = RNG.normal(size=(5, 20)).astype(np.float32), RNG.random(len(chosen)).astype(np.float32)
    sums, expected = np.full(18, 7.0, np.float32), np.full(18, 7.0, np.float32)
    expected[:16] = 0.0
    for row, weight in zip(chosen, weights, strict=True):
        expected[:16] += weight * values[row, 2:18]  # 8 bytes after its start
    _sum(sums, values, np.array(chosen, np.int64), weights)
    np.testing.assert_array_equal(sums, expected)


@njit
def _ball_apart(points, x, y, z, squared):  # type: ignore[no-untyped-def]
    return lanes.in_ball_apart(points.ctypes.data + 8, 4 * points.shape[1], x, y, z, squared)


def test_points_in_a_ball_whose_coordinates_are_apart() -> None:
    points = RNG.uniform(-1.0, 1.0, (3, 21)).astype(np.float32)
    at, squared = RNG.uniform(-0.5, 0.5, 3).astype(np.float32), np.float32(0.6)
    away = points[:, 2:18] - at[:, None]
    within = away[0] * away[0] + away[1] * away[1] + away[2] * away[2] <= squared
    assert _ball_apart(points, *at, squared) == bits(within) and 0 < within.sum() < 16


@njit
def _turned(points, boxes, axes, middle, half):  # type: ignore[no-untyped-def]
    given = (
        axes[0, 0], axes[0, 1], axes[0, 2], axes[1, 0], axes[1, 1], axes[1, 2], axes[2, 0], axes[2, 1], axes[2, 2],
        middle[0], middle[1], middle[2], half[0], half[1], half[2],
    )  # fmt: skip
    return lanes.in_turned_box(points.ctypes.data, *given), lanes.boxes_at_turned_box(boxes.ctypes.data, *given)


@njit
def _drawn(points, known, x, y, z):  # type: ignore[no-untyped-def]
    most = lanes.draw(points.ctypes.data, known.ctypes.data, x, y, z)
    return most, lanes.points_with(known.ctypes.data, most)


@njit
def _lowest(some):  # type: ignore[no-untyped-def]
    found = []
    while some != 0:
        found.append(lanes.lowest_bit(some))
        some &= some - 1
    return found


def test_points_in_a_ball_its_surface_included() -> None:
    for _ in range(50):
        points = RNG.random((3, SIZE)).astype(np.float32)
        x, y, z = RNG.random(3).astype(np.float32)
        squared = np.square(points - np.array([[x], [y], [z]])).sum(axis=0)
        limit = np.sort(squared)[9]
        assert _ball(points, x, y, z, limit) == bits(squared <= limit)


def test_points_and_boxes_at_a_turned_box() -> None:
    found = missed = 0
    for seed in range(50):
        axes = Rotation.random(rng=np.random.default_rng(seed)).as_matrix().T.astype(np.float32)
        middle, half = RNG.random(3).astype(np.float32), RNG.uniform(0.05, 0.4, 3).astype(np.float32)
        points, lower = RNG.random((3, SIZE)).astype(np.float32), RNG.random((3, GROUP)).astype(np.float32)
        boxes = np.concatenate([lower, lower + np.float32(0.1)])
        inside, meeting = _turned(points, boxes, axes, middle, half)
        assert inside == bits((np.abs(axes @ (points - middle[:, None])) < half[:, None]).all(axis=0))
        # Of a fine grid in each box, no point may be in the turned one where that is said to be apart.
        grid = np.stack(np.meshgrid(*[np.linspace(0.0, 0.1, 9)] * 3), axis=-1).reshape(-1, 3)
        for b in range(GROUP):
            own = lower[:, b] + grid
            touches = bool((np.abs((own - middle) @ axes.T) < half).all(axis=1).any())
            said = bool((meeting >> b) & 1)
            assert said or not touches
            found, missed = found + touches, missed + (said and not touches)
    assert found > 60 and missed < found


def test_distances_to_what_is_drawn() -> None:
    points, known = RNG.random((3, SIZE)).astype(np.float32), np.full(SIZE, 0.2, np.float32)
    expected = np.minimum(np.square(points - np.float32(0.5)).sum(axis=0), np.float32(0.2))
    half = np.float32(0.5)
    most, where = _drawn(points, known, half, half, half)
    np.testing.assert_array_equal(known, expected)
    assert most == expected.max() and where == bits(expected == most)


def test_bits_from_the_lowest() -> None:
    assert _lowest(np.int64(0b1001_0000_0010)) == [1, 8, 11] and _lowest(np.int64(1 << 31)) == [31]


def test_buckets_are_what_searches_expect() -> None:
    """Vectors of 32 points and 16 boxes are read from memory without gaps."""
    made: Buckets = in_buckets(cloud(3000))
    assert (SIZE, GROUP) == (lanes.POINTS, lanes.BOXES)
    for array in (made.points, made.rows, made.boxes, made.groups):
        assert array.flags.c_contiguous and array.itemsize == 4
