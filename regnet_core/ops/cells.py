"""Cells of horizontal grids that points are in."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array, Mask
from regnet_core.ops.compiled import compiled


def cells_below(points: npt.NDArray[Any], cell: float) -> npt.NDArray[np.int64]:
    """(N, 2): floor(x / cell) and floor(y / cell) of points (N, >= 2)."""
    index = np.empty((len(points), 2), np.int64)
    _floor(points, cell, index)
    return index


_MAP = 4_000_000
"""Cells of the largest map that is made to count those with points."""


def cells_with_points(points: npt.NDArray[Any], cell: float) -> int:
    """How many cells there are with points (N, >= 2), by x and y."""
    if len(points) == 0:
        return 0
    index = cells_below(points, cell)
    low, high = bounds_of_cells(index)
    size = high - low + 1
    if float(size[0]) * float(size[1]) > _MAP:
        return len(np.unique(index, axis=0))
    seen = np.zeros(int(size[0] * size[1]), np.bool_)
    seen[flat_cells(index, low, size[1])] = True
    return int(np.count_nonzero(seen))


@compiled
def bounds_of_cells(index):  # type: ignore[no-untyped-def]
    """The least and the largest cell (2,) along each axis of cells (N, 2), N > 0."""
    i0 = i1 = index[0, 0]
    j0 = j1 = index[0, 1]
    for p in range(len(index)):
        i0, i1 = min(i0, index[p, 0]), max(i1, index[p, 0])
        j0, j1 = min(j0, index[p, 1]), max(j1, index[p, 1])
    return np.array([i0, j0]), np.array([i1, j1])


@compiled
def flat_cells(index, low, across):  # type: ignore[no-untyped-def]
    """(N,): the number of each cell (N, 2) on a map that begins at the cell ``low`` and is ``across`` cells wide."""
    flat = np.empty(len(index), np.int64)
    for p in range(len(index)):
        flat[p] = (index[p, 0] - low[0]) * across + index[p, 1] - low[1]
    return flat


def mark_slab(
    points: npt.NDArray[Any],
    height: Array,
    between: tuple[float, float],
    low: Array,
    cell: float,
    rim: int,
    marked: Mask,
) -> None:
    """Mark the cells (nx, ny) below the points (N, >= 2) whose heights (N,) are between two.

    Args:
        points: all on the map [m].
        height: of the points [m].
        between: the two heights, not included [m].
        low: (2,), the lower corner of cell (rim, rim) [m].
        cell: edge length of a cell [m].
        rim: how many cells the map begins before that one.
        marked: what changes.
    """
    _in_slab(points, height, between, low, cell, rim, marked, True)


def count_in_slab(
    points: npt.NDArray[Any],
    height: Array,
    between: tuple[float, float],
    low: Array,
    cell: float,
    rim: int,
    marked: Mask,
) -> int:
    """How many of the points whose heights are between two are above marked cells; as for ``mark_slab``."""
    return int(_in_slab(points, height, between, low, cell, rim, marked, False))


@compiled
def _in_slab(points, height, between, low, cell, rim, marked, mark):  # type: ignore[no-untyped-def]
    count = 0
    for p in range(len(points)):
        if between[0] < height[p] < between[1]:
            i, j = int((points[p, 0] - low[0]) / cell) + rim, int((points[p, 1] - low[1]) / cell) + rim
            if mark:
                marked[i, j] = True
            else:
                count += marked[i, j]
    return count


def mark_nearest(points: npt.NDArray[Any], low: Array, cell: float, marked: npt.NDArray[np.bool_]) -> None:
    """Mark, in (nx, ny), the cell whose centre is nearest to each point (N, >= 2); all must be on the map.

    Args:
        points: (N, >= 2) [m].
        low: (2,), the centre of cell (0, 0) [m].
        cell: edge length of a cell [m].
        marked: what changes.
    """
    _mark(points, low, cell, marked)


def highest(points: npt.NDArray[Any], height: Array, low: Array, cell: float, shape: tuple[int, int]) -> Array:
    """(nx, ny): the largest height (N,) of the points (N, >= 2) nearest to each cell, or 0.

    Args:
        points: (N, >= 2) [m], all on the map.
        height: (N,) [m].
        low: (2,), the centre of cell (0, 0) [m].
        cell: edge length of a cell [m].
        shape: nx, ny.
    """
    top = np.zeros(shape)
    _raise(points, height, low, cell, top)
    return top


@compiled
def _raise(points, height, low, cell, top):  # type: ignore[no-untyped-def]
    for p in range(len(points)):
        i = np.int64(np.rint((points[p, 0] - low[0]) / cell))
        j = np.int64(np.rint((points[p, 1] - low[1]) / cell))
        top[i, j] = max(top[i, j], height[p])


@compiled
def _floor(points, cell, index):  # type: ignore[no-untyped-def]
    for p in range(len(points)):
        index[p, 0] = np.int64(np.floor(points[p, 0] / cell))
        index[p, 1] = np.int64(np.floor(points[p, 1] / cell))


@compiled
def _mark(points, low, cell, marked):  # type: ignore[no-untyped-def]
    for p in range(len(points)):
        i = np.int64(np.rint((points[p, 0] - low[0]) / cell))
        j = np.int64(np.rint((points[p, 1] - low[1]) / cell))
        marked[i, j] = True


@compiled
def mark(marked, rows):  # type: ignore[no-untyped-def]
    """Mark some of (M,), by their numbers (N,)."""
    for i in range(len(rows)):
        marked[rows[i]] = True


@compiled
def less_one(labels, rows):  # type: ignore[no-untyped-def]
    """(N,) int64: one less than the numbers at places (N,) of (M,)."""
    found = np.empty(len(rows), np.int64)
    for i in range(len(rows)):
        found[i] = labels[rows[i]] - 1
    return found
