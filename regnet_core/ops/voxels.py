"""The first points of a cloud in each voxel, and how many these are."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.ops.compiled import compiled, inlined
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import bounds

_HASH = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio: its multiples are spread evenly."""
_NONE = np.uint64(0xFFFFFFFFFFFFFFFF)
"""The number of no voxel."""
_BITS = 21
"""Of the number of a voxel along an axis."""
_PARTS, _TOGETHER, _BYTES = 8, 512, 8192
"""In so many parts points are counted, of each so many at a time; those whose byte of so many is 0 are passed over."""
_HALF, _EXACT = 2**20, 2**52


def share_kept(
    points: npt.NDArray[Any], rows: npt.NDArray[np.int64] | None, size: float, largest: float, probes: int = 512
) -> float:
    """About how large a share of points ``first_in_voxels`` keeps, from a look at what shares voxels with some of them.

    Args:
        points: (N, 3) [m].
        rows: (K,) of those that count; None: all of them.
        size: of the voxels [m].
        largest: no coordinate of these points is larger [m]; where it is more than a million voxels, 0 is returned.
        probes: so many points are looked at.
    """
    count = len(points) if rows is None else len(rows)
    if largest / size >= _HALF - 1 or count == 0:
        return 0.0
    flat, every = np.ascontiguousarray(points).reshape(-1), np.empty(0, np.int64) if rows is None else rows
    per_metre = points.dtype.type(1.0 / size)
    table, places, there = _probed(flat, every, count, min(probes, count), per_metre)
    met = np.zeros((_PARTS, len(table)), np.int32)
    for_each_range(_meet, _PARTS, 2 * count / _PARTS, flat, every, count, per_metre, table, there, met)
    return _mean_share(met, places)  # type: ignore[no-any-return]


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
def _probed(flat, rows, count, probes, per_metre):  # type: ignore[no-untyped-def]
    """The voxels that some of the points are in, as a table (a power of two) with gaps of _NONE; where in it that of
    each of these points is; and bytes, of which that of each of these points is not 0."""
    size = 8
    while size < 4 * probes:
        size *= 2
    table, places, there = np.full(size, _NONE), np.empty(probes, np.int64), np.zeros(_BYTES, np.uint8)
    own = np.empty(1, np.int32)
    for n in range(probes):
        p = n * count // probes
        p = 3 * (rows[p] if len(rows) > 0 else p)
        number = _of_point(flat[p], flat[p + 1], flat[p + 2], -_HALF, -_HALF, -_HALF, per_metre)
        places[n] = _place(table, number)
        table[places[n]] = number
        _bytes_of(flat[p : p + 3], per_metre, own)
        there[own[0]] = 1
    return table, places, there


@compiled
def _meet(begin, end, flat, rows, count, per_metre, table, there, met):  # type: ignore[no-untyped-def]
    """Of parts of the points: how many there are in each of the table's voxels."""
    at, places = np.empty(3 * _TOGETHER, flat.dtype), np.empty(_TOGETHER, np.int32)
    for part in range(begin, end):
        last = count * (part + 1) // len(met)
        for first in range(count * part // len(met), last, _TOGETHER):
            size = min(_TOGETHER, last - first)
            if len(rows) > 0:
                for n in range(size):
                    p = 3 * rows[first + n]
                    at[3 * n], at[3 * n + 1], at[3 * n + 2] = flat[p], flat[p + 1], flat[p + 2]
                _bytes_of(at[: 3 * size], per_metre, places)
            else:
                _bytes_of(flat[3 * first : 3 * (first + size)], per_metre, places)
            for n in range(size):
                if there[places[n]] != 0:
                    p = 3 * (rows[first + n] if len(rows) > 0 else first + n)
                    number = _of_point(flat[p], flat[p + 1], flat[p + 2], -_HALF, -_HALF, -_HALF, per_metre)
                    place = _place(table, number)
                    met[part, place] += table[place] == number


@compiled
def _bytes_of(flat, per_metre, places):  # type: ignore[no-untyped-def]
    """Which byte points, (3 N) numbers, have, by the voxels that they are in; many points at a time."""
    for p in range(len(flat) // 3):
        i = np.int32(np.floor(flat[3 * p] * per_metre))
        j = np.int32(np.floor(flat[3 * p + 1] * per_metre))
        k = np.int32(np.floor(flat[3 * p + 2] * per_metre))
        mixed = i * np.int32(73856093) ^ j * np.int32(19349663) ^ k * np.int32(83492791)
        places[p] = (mixed ^ (mixed >> np.int32(15))) & np.int32(_BYTES - 1)


@compiled
def _mean_share(met, places):  # type: ignore[no-untyped-def]
    share = 0.0
    for n in range(len(places)):
        share += 1.0 / met[:, places[n]].sum()
    return share / len(places)


@inlined
def _place(table, number):  # type: ignore[no-untyped-def]
    """Where a voxel is in a table (a power of two) with gaps of _NONE, or would be."""
    mask = np.uint64(len(table) - 1)
    place = ((number * _HASH) >> np.uint64(32)) & mask
    while table[place] != _NONE and table[place] != number:
        place = (place + np.uint64(1)) & mask
    return place


@inlined
def _of_point(a, b, c, x, y, z, per_metre):  # type: ignore[no-untyped-def]
    """The number of the voxel that a point is in."""
    i = np.int64(np.floor(a * per_metre)) - x
    j = np.int64(np.floor(b * per_metre)) - y
    k = np.int64(np.floor(c * per_metre)) - z
    return np.uint64((i << _BITS | j) << _BITS | k)


@compiled
def _number(begin, end, points, rows, low, per_metre, numbers):  # type: ignore[no-untyped-def]
    x, y, z = low[0], low[1], low[2]
    for n in range(begin, end):
        p = rows[n]
        numbers[n] = _of_point(points[p, 0], points[p, 1], points[p, 2], x, y, z, per_metre)


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
