"""The usable points of a cloud, and the first of them in each voxel."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.rows import blocks_of_rows, within_box
from regnet_core.ops.voxel_grid import bounds

_HASH = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio: its multiples are spread evenly."""
_NONE = np.uint64(0xFFFFFFFFFFFFFFFF)
"""The number of no voxel."""
_BITS = 21
"""Of the number of a voxel along an axis."""
_HALF, _EXACT = 2**20, 2**52


class Usable(NamedTuple):
    """Which points of a cloud can be used."""

    rows: npt.NDArray[np.int64]
    """(K,), ascending."""
    valid: int
    """How many points are valid, wherever they lie."""


def usable_points(
    points: npt.NDArray[Any], largest: float, lower: npt.NDArray[np.float64], upper: npt.NDArray[np.float64]
) -> Usable:
    """Points whose coordinates are numbers of at most a size, in a box.

    Args:
        points: (N, 3), in any layout [m].
        largest: coordinates beyond it are not valid [m].
        lower: (3,) corner of the box, which counts as inside; infinity has no limit [m].
        upper: (3,), likewise.
    """
    blocks = blocks_of_rows(len(points))
    counts, turns = np.empty((blocks, 2), np.int64), len(points) / blocks
    lower, upper = np.maximum(lower, -largest), np.minimum(upper, largest)
    for_each_range(_count, blocks, 1.5 * turns, points, largest, lower, upper, counts)
    valid, inside = (int(number) for number in counts.sum(axis=0))
    if inside == len(points):
        return Usable(np.arange(inside), valid)
    rows, ends = np.empty(inside, np.int64), np.cumsum(counts[:, 1])
    for_each_range(_list, blocks, 1.5 * turns, points, lower, upper, ends - counts[:, 1], ends, rows)
    return Usable(rows, valid)


def first_in_voxels(
    points: npt.NDArray[Any], rows: npt.NDArray[np.int64], size: float, largest: float
) -> npt.NDArray[np.int64] | None:
    """Rows of the first point in each cubic voxel of edge length ``size`` [m], ascending.

    Args:
        points: (N, 3) [m].
        rows: (K,) of those that count, ascending.
        size: [m]; the origin is a corner of a voxel.
        largest: no coordinate of these points is larger [m].

    Returns:
        The rows; None where the points are spread over more voxels than 64 bits can number.
    """
    if len(rows) == 0:
        return rows
    low, per_metre = np.full(3, -_HALF, np.int64), points.dtype.type(1.0 / size)
    if largest / size >= _HALF - 1:
        corners = np.floor(np.stack(bounds(points[rows])) * per_metre)
        if not (corners[1] - corners[0]).max() < 2 * _HALF or np.abs(corners).max() > _EXACT:
            return None
        low = corners[0].astype(np.int64)
    numbers = np.empty(len(rows), np.uint64)
    for_each_range(_number, len(rows), 2, points, rows, low, per_metre, numbers)
    first, bits = np.empty(len(rows) + 1, np.int64), max((2 * len(rows) - 1).bit_length(), 1)
    table = np.full(1 << bits, _NONE, np.uint64)
    return first[: _first(numbers, rows, table, np.uint64(64 - bits), first)]


@compiled
def _count(begin, end, points, largest, lower, upper, counts):  # type: ignore[no-untyped-def]
    """Of blocks of points: how many are valid, and how many of those are in the box."""
    for block in range(begin, end):
        valid = inside = 0
        for p in range(len(points) * block // len(counts), len(points) * (block + 1) // len(counts)):
            x, y, z = points[p, 0], points[p, 1], points[p, 2]
            valid += (abs(x) <= largest) & (abs(y) <= largest) & (abs(z) <= largest)
            inside += within_box(lower, upper, x, y, z)
        counts[block, 0], counts[block, 1] = valid, inside


@compiled
def _list(begin, end, points, lower, upper, starts, ends, rows):  # type: ignore[no-untyped-def]
    for block in range(begin, end):
        n = starts[block]
        for p in range(len(points) * block // len(starts), len(points) * (block + 1) // len(starts)):
            if n == ends[block]:
                break
            # Without a branch that nobody could foresee: written over by the next one where it is outside.
            rows[n] = p
            n += within_box(lower, upper, points[p, 0], points[p, 1], points[p, 2])


@compiled
def _number(begin, end, points, rows, low, per_metre, numbers):  # type: ignore[no-untyped-def]
    x, y, z = low[0], low[1], low[2]
    for n in range(begin, end):
        p = rows[n]
        i = np.int64(np.floor(points[p, 0] * per_metre)) - x
        j = np.int64(np.floor(points[p, 1] * per_metre)) - y
        k = np.int64(np.floor(points[p, 2] * per_metre)) - z
        numbers[n] = (i << _BITS | j) << _BITS | k


@compiled
def _first(numbers, given, table, shift, rows):  # type: ignore[no-untyped-def]
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
        rows[n] = given[p]
        n += there == _NONE
    return n
