"""Convex outlines seen from above: which points can be their corners, and which points are outside."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array, Mask
from regnet_core.ops.compiled import compiled

_DIRECTIONS = np.array(
    [[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [-1.0, 1.0], [-1.0, 0.0], [-1.0, -1.0], [0.0, -1.0], [1.0, -1.0]]
)
"""Counter-clockwise."""


def corner_candidates(points: npt.NDArray[Any], wanted: Mask) -> npt.NDArray[np.int64]:
    """Rows, ascending, of points among which all corners of the convex hull of their x, y are.

    Those inside the octagon of the farthest points in eight directions are left out, usually nearly all (Akl and
    Toussaint, 1978).

    Args:
        points: (N, >= 2).
        wanted: (N,), which of them count, at least one.
    """
    rows = np.empty(len(points), np.int64)
    return rows[: _not_inside(points, wanted, _DIRECTIONS, rows)]


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
    farthest, best = np.zeros(count, np.int64), np.full(count, -np.inf)
    for p in range(len(points)):
        if not wanted[p]:
            continue
        for d in range(count):
            value = directions[d, 0] * points[p, 0] + directions[d, 1] * points[p, 1]
            if value > best[d]:
                best[d], farthest[d] = value, p
    # Sides of the octagon, from corner to corner; those between equal corners are none.
    a, b, c = np.zeros(count), np.zeros(count), np.zeros(count)
    sides = 0
    for d in range(count):
        x0, y0 = points[farthest[d], 0], points[farthest[d], 1]
        x1, y1 = points[farthest[(d + 1) % count], 0], points[farthest[(d + 1) % count], 1]
        if x0 != x1 or y0 != y1:
            a[sides], b[sides] = y0 - y1, x1 - x0
            c[sides] = a[sides] * x0 + b[sides] * y0
            sides += 1
    n = 0
    for p in range(len(points)):
        within = sides > 2
        for s in range(sides):
            # The margin is for rounding: what is on a side stays.
            within &= a[s] * points[p, 0] + b[s] * points[p, 1] - c[s] > 1e-12
        rows[n] = p
        n += wanted[p] and not within
    return n


@compiled
def _outside(points, outline, margin, result):  # type: ignore[no-untyped-def]
    for p in range(len(points)):
        for h in range(len(outline)):
            if outline[h, 0] * points[p, 0] + outline[h, 1] * points[p, 1] + outline[h, 2] > margin:
                result[p] = True
                break
