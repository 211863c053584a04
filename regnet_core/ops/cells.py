"""Cells of horizontal grids that points are in."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.cell_map import CellMap
from regnet_core.ops.compiled import compiled
from regnet_core.ops.squares import closed_loop


def cells_below(points: npt.NDArray[Any], cell: float) -> npt.NDArray[np.int64]:
    """(N, 2): floor(x / cell) and floor(y / cell) of points (N, >= 2)."""
    index = np.empty((len(points), 2), np.int64)
    _floor(points, cell, index)
    return index


def cells_with_points(points: npt.NDArray[Any], cell: float) -> int:
    """How many cells there are with points (N, >= 2), by x and y."""
    if len(points) == 0:
        return 0
    found = CellMap.of(points, cell)
    return len(np.unique(cells_below(points, cell), axis=0)) if found is None else int(np.count_nonzero(found.number))


class Carried(NamedTuple):
    """What each of P planes is seen to be, and to carry."""

    area: Array
    """(P,): of the cells in which it was seen [m2]."""
    points: npt.NDArray[np.int64]
    """(P,): points that stand on it, above where it was seen or gaps of that; 0 for planes of less than ``least``."""


def carried(
    points: npt.NDArray[Any],
    planes: Array,
    corners: tuple[Array, Array],
    cell: float,
    tolerance: float,
    reach: float,
    gap: int,
    least: float,
) -> Carried:
    """Where planes were seen, and what stands there.

    Args:
        points: (N, 3) [m].
        planes: (P, 4), unit normals and offsets [m].
        corners: of the points' bounding box.
        cell: edge length of the horizontal cells [m].
        tolerance: a plane was seen where points are nearer than this; what stands on it is more than twice as high [m].
        reach: what is higher says nothing [m].
        gap: gaps of twice so many cells are closed.
        least: only one of several planes that are larger than this can be looked for what it carries [m2].
    """
    low, high = corners
    size = ((high[:2] - low[:2]) / cell).astype(np.int64) + 1
    seen = np.zeros((len(planes), size[0] + 2 * gap + 2, size[1] + 2 * gap + 2), np.uint8)
    found = Carried(np.empty(len(planes)), np.zeros(len(planes), np.int64))
    _carried(points, planes, low, cell, tolerance, reach, gap, least, seen, *found)
    return found


@compiled
def _carried(points, planes, low, cell, tolerance, reach, gap, least, seen, areas, counts):  # type: ignore[no-untyped-def]
    large = 0
    for k in range(len(planes)):
        _in_slab(points, planes[k], -tolerance, tolerance, low, cell, gap + 1, seen[k], True)
        areas[k] = cell * cell * seen[k].sum()
        large += areas[k] >= least
    for k in range(len(planes)):
        if large > 1 and areas[k] >= least:
            filled = closed_loop(seen[k], gap)
            counts[k] = _in_slab(points, planes[k], 2.0 * tolerance, reach, low, cell, gap + 1, filled, False)


@compiled
def _in_slab(points, plane, lowest, highest, low, cell, rim, marked, mark):  # type: ignore[no-untyped-def]
    """Mark the cells below the points that are between two heights, or count the points above marked ones."""
    count, a, b, c, d = 0, plane[0], plane[1], plane[2], plane[3]
    for p in range(len(points)):
        x, y = points[p, 0], points[p, 1]
        height = a * x + b * y + c * points[p, 2] - d
        if lowest < height < highest:
            i, j = int((x - low[0]) / cell) + rim, int((y - low[1]) / cell) + rim
            if mark:
                marked[i, j] = 1
            else:
                count += marked[i, j]
    return count


def seen_from_above(
    parts: tuple[npt.NDArray[Any], npt.NDArray[Any]], low: Array, cell: float, shape: tuple[int, int], reach: int
) -> npt.NDArray[np.bool_]:
    """(nx, ny): the cells whose centres are nearest to points, and gaps of up to twice ``reach`` between them.

    Args:
        parts: points (N, >= 2) [m], all on the map.
        low: (2,), the centre of cell (0, 0) [m].
        cell: edge length of a cell [m].
        shape: nx, ny.
        reach: [cells].
    """
    marked = np.zeros(shape, np.uint8)
    grids = [tuple(points.dtype.type(number) for number in (low[0], low[1], 1.0 / cell)) for points in parts]
    return _seen(parts[0], grids[0], parts[1], grids[1], marked, reach).view(np.bool_)  # type: ignore[no-any-return]


def highest(
    points: npt.NDArray[Any], height: Array, low: Array, cell: float, shape: tuple[int, int], reach: int
) -> Array:
    """(nx, ny): the largest height (N,) of the points (N, >= 2) nearest to each cell; where there is none, or only 0,
    what closing gives, which fills gaps of up to twice ``reach``.

    Args:
        points: (N, >= 2) [m], all on the map.
        height: (N,) [m].
        low: (2,), the centre of cell (0, 0) [m].
        cell: edge length of a cell [m].
        shape: nx, ny.
        reach: [cells].
    """
    return _highest(points, height, low, cell, np.zeros(shape), reach)  # type: ignore[no-any-return]


@compiled
def _highest(points, height, low, cell, top, reach):  # type: ignore[no-untyped-def]
    for p in range(len(points)):
        i = np.int64(np.rint((points[p, 0] - low[0]) / cell))
        j = np.int64(np.rint((points[p, 1] - low[1]) / cell))
        top[i, j] = max(top[i, j], height[p])
    filled = closed_loop(top, reach)
    for x in range(len(top)):
        for y in range(top.shape[1]):
            if top[x, y] <= 0.0:
                top[x, y] = filled[x, y]
    return top


@compiled
def _floor(points, cell, index):  # type: ignore[no-untyped-def]
    for p in range(len(points)):
        index[p, 0] = np.int64(np.floor(points[p, 0] / cell))
        index[p, 1] = np.int64(np.floor(points[p, 1] / cell))


@compiled
def _seen(some, grid, others, same_grid, marked, reach):  # type: ignore[no-untyped-def]
    _mark(some, grid, marked)
    _mark(others, same_grid, marked)
    return closed_loop(marked, reach)


@compiled
def _mark(points, grid, marked):  # type: ignore[no-untyped-def]
    x, y, per_metre = grid  # of the points' type
    for p in range(len(points)):
        i = np.int64(np.rint((points[p, 0] - x) * per_metre))
        j = np.int64(np.rint((points[p, 1] - y) * per_metre))
        marked[i, j] = 1
