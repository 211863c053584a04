"""Convex outlines seen from above: which points can be their corners, and which points are outside."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array, Mask
from regnet_core.ops.cell_map import CellMap
from regnet_core.ops.compiled import compiled

_ANGLES = np.arange(16) * (np.pi / 8)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""Counter-clockwise."""
_THINNEST = 1e-5
"""An outline of less area, as a share of the square of its circumference, is a line."""
_STRIDE = 32
"""The polygon is that of every so manyth point."""
_BLOCK = 64
"""Points that are compared with a side together."""


def corner_candidates(points: npt.NDArray[Any], cells: CellMap, wanted: Mask) -> npt.NDArray[np.int64]:
    """Rows, ascending, of points among which all corners of the convex hull of their x, y are.

    Those inside the polygon of points that are far out in sixteen directions are left out, usually nearly all (Akl and
    Toussaint, 1978), most of them as a cell at a time.

    Args:
        points: (N, >= 2).
        cells: that they are in.
        wanted: (C,), in which cells they count, at least in one.
    """
    rows = np.empty(len(points), np.int64)
    corner = (float(cells.first[0]) * cells.cell, float(cells.first[1]) * cells.cell)
    given = (points, cells.place, wanted.copy(), corner, cells.across, cells.cell, _DIRECTIONS)
    return rows[: _not_inside(*given, rows)]


def convex_outline(points: npt.NDArray[Any], rows: npt.NDArray[np.int64] | None = None) -> Array:
    """(H, 3): the sides of the convex hull of points (N, >= 2), N > 0, seen from above; none where all are in a line.

    Each side is its outward unit normal and an offset: normal . xy + offset <= 0 inside. Monotone chains (Andrew,
    "Another efficient algorithm for convex hulls in two dimensions", 1979).

    Args:
        points: (N, >= 2).
        rows: of those that count; None: all.
    """
    return _outline(points, np.arange(len(points)) if rows is None else rows)  # type: ignore[no-any-return]


def outside(points: npt.NDArray[Any], outline: Array, margin: float) -> Mask:
    """(N,): which of the points (N, >= 2) are farther than ``margin`` from one of the outline's lines.

    Args:
        points: (N, >= 2).
        outline: (H, 3), each line's outward unit normal and offset, normal . xy + offset <= 0 inside.
        margin: a distance.
    """
    result = np.zeros(len(points), np.bool_)
    _outside(points, outline, margin, result)
    return result


@compiled
def _not_inside(points, place, wanted, corner, across, cell, directions, rows):  # type: ignore[no-untyped-def]
    count = len(directions)
    farthest, best = np.full(count, -1), np.full(count, -np.inf)
    for p in range(0, len(points), _STRIDE):  # any corners will do, the better the farther out they are
        if wanted[place[p]]:
            for d in range(count):
                value = directions[d, 0] * points[p, 0] + directions[d, 1] * points[p, 1]
                if value > best[d]:
                    best[d], farthest[d] = value, p
    # Sides of the polygon, from corner to corner; those between equal corners are none.
    a, b, c = np.zeros(count), np.zeros(count), np.zeros(count)
    sides = 0
    if farthest[0] >= 0:
        for d in range(count):
            x0, y0 = points[farthest[d], 0], points[farthest[d], 1]
            x1, y1 = points[farthest[(d + 1) % count], 0], points[farthest[(d + 1) % count], 1]
            if x0 != x1 or y0 != y1:
                a[sides], b[sides] = y0 - y1, x1 - x0
                c[sides] = a[sides] * x0 + b[sides] * y0
                sides += 1
    if sides > 2:
        for k in range(len(wanted)):
            if wanted[k]:
                x, y = corner[0] + (k // across + 0.5) * cell, corner[1] + (k % across + 0.5) * cell
                outermost = np.inf  # of a little more than the cell: rounding puts points beside it into it
                for s in range(sides):
                    outermost = min(outermost, a[s] * x + b[s] * y - c[s] - 0.51 * cell * (abs(a[s]) + abs(b[s])))
                # The margins are for rounding: what is on a side stays.
                wanted[k] = outermost <= 1e-9
    n = 0
    for p in range(len(points)):
        if not wanted[place[p]]:
            continue
        within = sides > 2
        for s in range(sides):
            within &= a[s] * points[p, 0] + b[s] * points[p, 1] - c[s] > 1e-12
        rows[n] = p
        n += not within
    return n


@compiled
def _outline(points, rows):  # type: ignore[no-untyped-def]
    return _sides(_corners(_in_order(points, rows)))


@compiled
def _in_order(points, rows):  # type: ignore[no-untyped-def]
    """x, y of points in order of x; of those with the same x the one of least y, then that of most."""
    x = np.empty(len(rows))
    for i in range(len(rows)):
        x[i] = points[rows[i], 0]
    order, made, n, i = np.argsort(x), np.empty((2 * len(rows), 2)), 0, 0
    while i < len(rows):
        here, low, high = x[order[i]], np.inf, -np.inf
        while i < len(rows) and x[order[i]] == here:
            y = np.float64(points[rows[order[i]], 1])
            low, high = min(low, y), max(high, y)
            i += 1
        made[n, 0], made[n, 1] = here, low
        n += 1
        if high > low:
            made[n, 0], made[n, 1] = here, high
            n += 1
    return made[:n]


@compiled
def _corners(points):  # type: ignore[no-untyped-def]
    """Those of the hull, counter-clockwise, of points (N, 2) in order of x, then y; ends where all are in a line."""
    chain, count, least = np.empty((2 * len(points) + 1, 2)), 0, 0
    for half in range(2):  # from left to right below, then back above
        for i in range(len(points)):
            p = points[i] if half == 0 else points[len(points) - 1 - i]
            while count - least >= 2:
                a, b = chain[count - 2], chain[count - 1]
                if (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0.0:
                    break
                count -= 1
            chain[count] = p
            count += 1
        count -= 1  # the other half begins with it
        least = count
    return chain[:count].copy()


@compiled
def _sides(corners):  # type: ignore[no-untyped-def]
    """Outward unit normals and offsets of a polygon's sides; none where it is no more than a line."""
    count = len(corners)
    sides, length, area = np.empty((count, 3)), 0.0, 0.0
    for h in range(count):
        p, q = corners[h], corners[(h + 1) % count]
        x, y = q[0] - p[0], q[1] - p[1]
        own = np.hypot(x, y)
        length += own
        area += 0.5 * ((p[0] - corners[0, 0]) * y - (p[1] - corners[0, 1]) * x)
        sides[h, 0], sides[h, 1] = y / own, -x / own
        sides[h, 2] = -(sides[h, 0] * p[0] + sides[h, 1] * p[1])
    # Rounding makes a thin polygon of points in a line.
    return sides if count > 2 and area > _THINNEST * length * length else sides[:0]


@compiled
def _outside(points, outline, margin, result):  # type: ignore[no-untyped-def]
    x, y, farthest = np.zeros(_BLOCK), np.zeros(_BLOCK), np.empty(_BLOCK)
    for first in range(0, len(points), _BLOCK):
        size = min(_BLOCK, len(points) - first)
        for q in range(size):
            x[q], y[q] = points[first + q, 0], points[first + q, 1]
        farthest[:] = -np.inf
        for h in range(len(outline)):
            a, b, c = outline[h, 0], outline[h, 1], outline[h, 2]
            for q in range(_BLOCK):
                away = a * x[q] + b * y[q] + c
                farthest[q] = away if away > farthest[q] else farthest[q]
        for q in range(size):
            result[first + q] = farthest[q] > margin
