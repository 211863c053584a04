"""Convex outlines seen from above: which points can be their corners, and which points are outside."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array, Mask
from regnet_core.ops.compiled import compiled

_ANGLES = np.arange(16) * (np.pi / 8)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""Counter-clockwise."""
_THINNEST = 1e-5
"""An outline of less area, as a share of the square of its circumference, is a line."""
_STRIDE, _BLOCK = 16, 64
"""The polygon is that of every so manyth point; so many points are looked at together."""


def corner_candidates(points: npt.NDArray[Any], wanted: Mask) -> npt.NDArray[np.int64]:
    """Rows, ascending, of points among which all corners of the convex hull of their x, y are.

    Those inside the polygon of points that are far out in sixteen directions are left out, usually nearly all (Akl and
    Toussaint, 1978).

    Args:
        points: (N, >= 2).
        wanted: (N,), which of them count, at least one.
    """
    rows = np.empty(len(points), np.int64)
    return rows[: _not_inside(points, wanted, _DIRECTIONS, rows)]


def convex_outline(points: npt.NDArray[Any]) -> Array:
    """(H, 3): the sides of the convex hull of points (N, >= 2), N > 0, seen from above; none where all are in a line.

    Each side is its outward unit normal and an offset: normal . xy + offset <= 0 inside. Monotone chains (Andrew,
    "Another efficient algorithm for convex hulls in two dimensions", 1979).
    """
    order = np.lexsort((points[:, 1], points[:, 0]))
    corners = _corners(np.ascontiguousarray(points[order, :2], dtype=np.float64))
    along = np.roll(corners, -1, axis=0) - corners
    length = np.hypot(along[:, 0], along[:, 1])
    if len(corners) < 3:
        return np.zeros((0, 3))
    from_first = corners - corners[0]
    area = 0.5 * np.sum(from_first[:, 0] * along[:, 1] - from_first[:, 1] * along[:, 0])
    if area <= _THINNEST * np.sum(length) ** 2:  # what rounding makes of points in a line
        return np.zeros((0, 3))
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / length[:, None]
    return np.column_stack([normal, -np.sum(normal * corners, axis=1)])


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
def _not_inside(points, wanted, directions, rows):  # type: ignore[no-untyped-def]
    count = len(directions)
    farthest, best = np.full(count, -1), np.full(count, -np.inf)
    for p in range(0, len(points), _STRIDE):  # any corners will do, the better the farther out they are
        if wanted[p]:
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
    n = 0
    x, y, within = np.zeros(_BLOCK), np.zeros(_BLOCK), np.zeros(_BLOCK, np.uint8)
    for first in range(0, len(points), _BLOCK):
        size = min(_BLOCK, len(points) - first)
        for q in range(size):
            x[q], y[q] = points[first + q, 0], points[first + q, 1]
            within[q] = sides > 2
        for s in range(sides):
            for q in range(_BLOCK):
                # The margin is for rounding: what is on a side stays.
                within[q] &= np.uint8(a[s] * x[q] + b[s] * y[q] - c[s] > 1e-12)
        for q in range(size):
            rows[n] = first + q
            n += wanted[first + q] and within[q] == 0
    return n


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
def _outside(points, outline, margin, result):  # type: ignore[no-untyped-def]
    for p in range(len(points)):
        for h in range(len(outline)):
            if outline[h, 0] * points[p, 0] + outline[h, 1] * points[p, 1] + outline[h, 2] > margin:
                result[p] = True
                break
