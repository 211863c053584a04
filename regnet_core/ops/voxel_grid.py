"""A uniform grid over points, for visiting the points of any small region quickly."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled, inlined

_MAX_CELLS = 4_000_000
"""Clouds so wide that they would need more cells get larger ones."""


class VoxelGrid(NamedTuple):
    """Points sorted by cell; the points of the cells (i, j, k0..k1) are contiguous."""

    points: Array
    """(N, 3) in the order of their cells."""
    order: npt.NDArray[np.int64]
    """(N,): the index of each of these points in the input."""
    start: npt.NDArray[np.int64]
    """(cells + 1,): where each cell's points begin."""
    origin: Array
    """(3,): lower corner of cell (0, 0, 0) [m]."""
    shape: npt.NDArray[np.int64]
    """(3,): number of cells along each axis."""
    cell: float
    """Edge length of a cell [m]."""


def build_grid(points: Array, cell: float) -> VoxelGrid:
    """Sort points (N, 3) into cubic cells of edge length ``cell`` [m]."""
    if len(points) == 0:
        points = np.zeros((0, 3))
        return VoxelGrid(points, np.zeros(0, np.int64), np.zeros(2, np.int64), np.zeros(3), np.ones(3, np.int64), cell)
    return VoxelGrid(*_sorted(np.ascontiguousarray(points), float(cell), _MAX_CELLS))


_TOGETHER = 16
"""Points that are looked at together for their bounds."""


def bounds(points: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Lower and upper corner (D,) of the bounding box of finite points (N, D), N > 0; in the points' own type."""
    return bounds_loop(np.ascontiguousarray(points))  # type: ignore[no-any-return]


@compiled
def bounds_loop(points):  # type: ignore[no-untyped-def]
    """``bounds`` of contiguous points, for other compiled functions."""
    low, high, axes = points[0].copy(), points[0].copy(), points.shape[1]
    whole = len(points) // _TOGETHER
    if whole > 0:  # of several points at a time, each with its own bounds
        least, most = points[:_TOGETHER].copy().reshape(-1), points[:_TOGETHER].copy().reshape(-1)
        for block in range(1, whole):
            some = points[block * _TOGETHER : (block + 1) * _TOGETHER].reshape(-1)
            for q in range(len(least)):
                value, below, above = some[q], least[q], most[q]
                least[q] = value if value < below else below
                most[q] = value if value > above else above
        for q in range(len(least)):
            low[q % axes], high[q % axes] = min(low[q % axes], least[q]), max(high[q % axes], most[q])
    for p in range(whole * _TOGETHER, len(points)):
        for a in range(axes):
            low[a] = min(low[a], points[p, a])
            high[a] = max(high[a], points[p, a])
    return low, high


@compiled
def _sorted(points, cell, most):  # type: ignore[no-untyped-def]
    """A counting sort: points of one cell keep their order."""
    origin, upper = bounds_loop(points)
    shape = np.empty(3, np.int64)
    while True:
        cells = 1.0
        for a in range(3):
            shape[a] = np.int64((upper[a] - origin[a]) / cell) + 1
            cells *= shape[a]
        if cells <= most:
            break
        cell *= 1.5
    ordered, order = np.empty_like(points), np.empty(len(points), np.int64)
    start = np.zeros(np.int64(cells) + 1, np.int64)
    keys = np.empty(len(points), np.int32)
    for p in range(len(points)):
        key = 0
        for a in range(3):
            key = key * shape[a] + min(int((points[p, a] - origin[a]) / cell), shape[a] - 1)
        keys[p] = key
        start[key + 1] += 1
    for c in range(1, len(start)):
        start[c] += start[c - 1]
    free = start.copy()
    for p in range(len(points)):
        place = free[keys[p]]
        free[keys[p]] += 1
        order[place] = p
        for a in range(3):
            ordered[place, a] = points[p, a]
    return ordered, order, start, origin, shape, cell


@inlined
def cell_range(low: float, high: float, origin: float, cell: float, size: int) -> tuple[int, int]:
    """First and last cell along one axis that [low, high] touches; an empty range when it misses the grid."""
    first = int(np.floor((low - origin) / cell))
    last = int(np.floor((high - origin) / cell))
    return max(first, 0), min(last, size - 1)


@inlined
def cells_of_box(pose, centre, half, origin, cell, shape):  # type: ignore[no-untyped-def]
    """First and last cells i0, i1, j0, j1, k0, k1 that a turned box can touch.

    ``pose`` (3, 3) has the box's axes as columns, ``centre`` (3 numbers) is its middle in the grid's frame and ``half``
    (3 numbers) its half lengths [m].
    """
    x = abs(pose[0, 0]) * half[0] + abs(pose[0, 1]) * half[1] + abs(pose[0, 2]) * half[2]
    y = abs(pose[1, 0]) * half[0] + abs(pose[1, 1]) * half[1] + abs(pose[1, 2]) * half[2]
    z = abs(pose[2, 0]) * half[0] + abs(pose[2, 1]) * half[1] + abs(pose[2, 2]) * half[2]
    i0, i1 = cell_range(centre[0] - x, centre[0] + x, origin[0], cell, shape[0])
    j0, j1 = cell_range(centre[1] - y, centre[1] + y, origin[1], cell, shape[1])
    k0, k1 = cell_range(centre[2] - z, centre[2] + z, origin[2], cell, shape[2])
    return i0, i1, j0, j1, k0, k1


@inlined
def along_approach(pose, c, x):  # type: ignore[no-untyped-def]
    """The point (3 numbers) at the distance ``x`` [m] from ``c`` along the first axis of ``pose``."""
    return c[0] + pose[0, 0] * x, c[1] + pose[1, 0] * x, c[2] + pose[2, 0] * x
