"""Which rows of a cloud stay: valid ones, those in the workspace, and the first in each voxel. One pass each."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import bounds

_HASH = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio: its multiples are spread evenly."""
_NONE = np.uint64(0xFFFFFFFFFFFFFFFF)
"""The number of no voxel."""


def valid_rows(points: npt.NDArray[Any], largest: float) -> npt.NDArray[np.int64]:
    """Rows of the points (N, 3) whose three coordinates are numbers of at most this size, ascending."""
    rows = np.empty(len(points), np.int64)
    return rows[: _valid(points, largest, rows)]


def moved_rows(
    points: npt.NDArray[Any], transform: Array, largest: float, lower: Array, upper: Array
) -> tuple[Array, npt.NDArray[np.int64], int]:
    """Valid points in another frame, where they lie in a box there.

    Args:
        points: (N, 3) in the source frame [m].
        transform: (4, 4), the pose of the source frame in the target frame.
        largest: as in ``valid_rows``.
        lower: (3,) corner of the box in the target frame [m]; infinity has no limit.
        upper: (3,), likewise.

    Returns:
        The points (K, 3) in the target frame [m], the rows (K,) that they were in, ascending, and how many of the N
        were valid.
    """
    moved, rows = np.empty((len(points), 3)), np.empty(len(points), np.int64)
    kept, valid = _moved(points, transform, largest, lower, upper, moved, rows)
    return moved[:kept], rows[:kept], valid


def rows_in_box(points: npt.NDArray[Any], lower: npt.NDArray[Any], upper: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Rows of the points (N, 3) in a box, its surface included, ascending.

    Args:
        points: (N, 3).
        lower: (3,) corner of the box, of the points' type.
        upper: (3,), likewise.
    """
    rows = np.empty(len(points), np.int64)
    return rows[: _inside(points, lower, upper, rows)]


def first_in_voxels(points: Array, size: float) -> npt.NDArray[np.int64] | None:
    """Rows of the first point in each cubic voxel of edge length ``size`` [m], ascending, for N > 0 points (N, 3).

    None where there could be more voxels than 64 bits can number.
    """
    low, high = bounds(points)
    shape = np.floor((high - low) / size) + 1.0
    if not float(np.prod(shape)) < 2.0**62:
        return None
    numbers = np.empty(len(points), np.uint64)
    for_each_range(_number, len(points), 3, points, low, size, shape, numbers)
    rows, bits = np.empty(len(points) + 1, np.int64), max((2 * len(points) - 1).bit_length(), 1)
    table = np.full(1 << bits, _NONE, np.uint64)
    return rows[: _first(numbers, table, np.uint64(64 - bits), rows)]


def chosen_rows(draws: npt.NDArray[np.float32], size: int) -> npt.NDArray[np.int64]:
    """``size`` of N rows, ascending, each set of them as likely as any other.

    Each row is taken with the chance of what is still wanted among what is still to come (selection sampling, Knuth,
    "The Art of Computer Programming", vol. 2, algorithm S).

    Args:
        draws: (N,) random numbers in [0, 1).
        size: at most N.
    """
    rows = np.empty(size + 1, np.int64)
    _choose(draws, size, rows)
    return rows[:size]


def taken(points: Array, rows: npt.NDArray[np.int64]) -> Array:
    """(K, 3): rows (K,) of points (N, 3); several times faster than indexing."""
    result = np.empty((len(rows), 3))
    for_each_range(_take, len(rows), 2, points, rows, result)
    return result


@compiled
def _take(begin, end, points, rows, result):  # type: ignore[no-untyped-def]
    for i in range(begin, end):
        row = rows[i]
        result[i, 0], result[i, 1], result[i, 2] = points[row, 0], points[row, 1], points[row, 2]


@compiled
def _choose(draws, size, rows):  # type: ignore[no-untyped-def]
    n, left = 0, len(draws)
    for p in range(len(draws)):
        # Without a branch: written over by the next one where it is not taken.
        rows[n] = p
        n += draws[p] * left < size - n
        left -= 1


@compiled
def _valid(points, largest, rows):  # type: ignore[no-untyped-def]
    n = 0
    for p in range(len(points)):
        # False for NaN.
        if abs(points[p, 0]) <= largest and abs(points[p, 1]) <= largest and abs(points[p, 2]) <= largest:
            rows[n] = p
            n += 1
    return n


@compiled
def _inside(points, lower, upper, rows):  # type: ignore[no-untyped-def]
    n = 0
    for p in range(len(points)):
        # Without a branch: written over by the next one where it is outside.
        rows[n] = p
        n += (
            (lower[0] <= points[p, 0] <= upper[0])
            & (lower[1] <= points[p, 1] <= upper[1])
            & (lower[2] <= points[p, 2] <= upper[2])
        )
    return n


@compiled
def _moved(points, transform, largest, lower, upper, moved, rows):  # type: ignore[no-untyped-def]
    n = valid = 0
    for p in range(len(points)):
        a, b, c = np.float64(points[p, 0]), np.float64(points[p, 1]), np.float64(points[p, 2])
        if not (abs(a) <= largest and abs(b) <= largest and abs(c) <= largest):
            continue
        valid += 1
        x = transform[0, 0] * a + transform[0, 1] * b + transform[0, 2] * c + transform[0, 3]
        y = transform[1, 0] * a + transform[1, 1] * b + transform[1, 2] * c + transform[1, 3]
        z = transform[2, 0] * a + transform[2, 1] * b + transform[2, 2] * c + transform[2, 3]
        if lower[0] <= x <= upper[0] and lower[1] <= y <= upper[1] and lower[2] <= z <= upper[2]:
            moved[n, 0], moved[n, 1], moved[n, 2] = x, y, z
            rows[n] = p
            n += 1
    return n, valid


@compiled
def _number(begin, end, points, low, size, shape, numbers):  # type: ignore[no-untyped-def]
    x, y, z, across, deep = low[0], low[1], low[2], np.uint64(shape[1]), np.uint64(shape[2])
    for p in range(begin, end):
        i = np.uint64(np.int64(np.floor((points[p, 0] - x) / size)))
        j = np.uint64(np.int64(np.floor((points[p, 1] - y) / size)))
        k = np.uint64(np.int64(np.floor((points[p, 2] - z) / size)))
        numbers[p] = (i * across + j) * deep + k


@compiled
def _first(numbers, table, shift, rows):  # type: ignore[no-untyped-def]
    """Fill ``rows`` and say how many there are; the table (a power of two, all _NONE) becomes a set of voxels."""
    mask = np.uint64(len(table) - 1)
    n = 0
    for p in range(len(numbers)):
        number = numbers[p]
        place = (number * _HASH) >> shift
        there = table[place]
        while there != _NONE and there != number:
            place = (place + np.uint64(1)) & mask
            there = table[place]
        table[place] = number
        # Without a branch: written over by the next one where the voxel is known.
        rows[n] = p
        n += there == _NONE
    return n
