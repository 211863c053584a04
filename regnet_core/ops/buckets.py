"""Points in small buckets of neighbours: what is asked of one point of a bucket is asked of all of them at a time.

A bucket has as many points as fill a few registers, so that compiled loops over it become a few instructions, and a
box around it, so that most of the other points are passed over without a look at them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from regnet_core.ops.compiled import compiled, inlined
from regnet_core.ops.voxel_grid import bounds

SIZE = 32
"""Points of a bucket."""
GROUP = 16
"""Buckets of a group."""
_BITS = 8
"""Of the number of a cell along an axis, by which points are sorted."""


class Buckets(NamedTuple):
    """N points along a curve that stays in small cubes (Morton's), in B buckets of ``SIZE`` and G groups of these.

    The last bucket is filled up with its last point.
    """

    points: npt.NDArray[np.float32]
    """(B, 3, SIZE): the x of a bucket's points, then their y, then their z [m]."""
    rows: npt.NDArray[np.int32]
    """(B, SIZE): which row of the input each of them is."""
    lower: npt.NDArray[np.float32]
    """(B, 3): lower corner of each bucket's bounding box [m]."""
    upper: npt.NDArray[np.float32]
    """(B, 3): upper corner [m]."""
    group_lower: npt.NDArray[np.float32]
    """(G, 3): lower corner of each group's bounding box [m]."""
    group_upper: npt.NDArray[np.float32]
    """(G, 3): upper corner [m]."""
    count: int
    """N."""


def in_buckets(points: npt.NDArray[np.float32]) -> Buckets:
    """Sort finite points (N, 3) [m] into buckets."""
    count = len(points)
    number = -(-count // SIZE)
    groups = -(-number // GROUP)
    made = Buckets(
        np.empty((number, 3, SIZE), np.float32),
        np.empty((number, SIZE), np.int32),
        np.empty((number, 3), np.float32),
        np.empty((number, 3), np.float32),
        np.empty((groups, 3), np.float32),
        np.empty((groups, 3), np.float32),
        count,
    )
    if count:
        points = np.ascontiguousarray(points)
        lower, upper = bounds(points)
        extent = max(float((upper - lower).max()), 1e-6)
        _fill(points, _along_the_curve(points, lower, np.float32((1 << _BITS) / extent)), made)
    return made


def point_buckets(points: torch.Tensor) -> Buckets | None:
    """Buckets for several searches of the same points (N, 3) on a CPU; None elsewhere, where none uses them."""
    return in_buckets(points.detach().float().numpy()) if points.device.type == "cpu" else None


@compiled
def _along_the_curve(points, origin, scale):  # type: ignore[no-untyped-def]
    """The rows of the points by their place on the curve: a radix sort of two digits; equal ones keep their order."""
    keys = np.empty(len(points), np.int32)
    for p in range(len(points)):
        key = 0
        for a in range(3):
            cell = min(int((points[p, a] - origin[a]) * scale), (1 << _BITS) - 1)
            # Two zeros between any two bits.
            cell = (cell | (cell << 8)) & 0x00F00F
            cell = (cell | (cell << 4)) & 0x0C30C3
            cell = (cell | (cell << 2)) & 0x249249
            key |= cell << a
        keys[p] = key
    half = 3 * _BITS // 2
    rows, other = np.arange(len(points)).astype(np.int32), np.empty(len(points), np.int32)
    for shift in (0, half):
        free = np.zeros((1 << half) + 1, np.int32)
        for p in range(len(points)):
            free[((keys[p] >> shift) & ((1 << half) - 1)) + 1] += 1
        for c in range(1, len(free)):
            free[c] += free[c - 1]
        for i in range(len(points)):
            digit = (keys[rows[i]] >> shift) & ((1 << half) - 1)
            other[free[digit]] = rows[i]
            free[digit] += 1
        rows, other = other, rows
    return rows


@compiled
def _fill(points, order, made):  # type: ignore[no-untyped-def]
    last = len(order) - 1
    for b in range(len(made.rows)):
        g = b // GROUP
        for i in range(SIZE):
            row = order[min(b * SIZE + i, last)]
            made.rows[b, i] = row
            for a in range(3):
                made.points[b, a, i] = points[row, a]
        for a in range(3):
            low, high = made.points[b, a].min(), made.points[b, a].max()
            made.lower[b, a], made.upper[b, a] = low, high
            first = b % GROUP == 0
            made.group_lower[g, a] = low if first else min(made.group_lower[g, a], low)
            made.group_upper[g, a] = high if first else max(made.group_upper[g, a], high)


@inlined
def gap_to_box(lower, upper, b, x, y, z):  # type: ignore[no-untyped-def]
    """The squared distance between box ``b`` and a point: rounded as distances to what is in the box are, it is no
    more than any of them."""
    zero = np.float32(0.0)
    x = max(lower[b, 0] - x, x - upper[b, 0], zero)
    y = max(lower[b, 1] - y, y - upper[b, 1], zero)
    z = max(lower[b, 2] - z, z - upper[b, 2], zero)
    return x * x + y * y + z * z


@inlined
def near_bucket(queries, b, points, squared, places):  # type: ignore[no-untyped-def]
    """Write down which points lie within a distance of bucket ``b``'s box, and say how many these are.

    ``squared`` is the distance's square; ``places`` has room for N + 1 numbers, SIZE * bucket + place in the bucket.
    """
    n, zero, gaps = 0, np.float32(0.0), np.empty(SIZE, np.float32)
    # In variables of their own: the compiler cannot know that writing to ``places`` leaves the box as it is.
    x0, y0, z0 = queries.lower[b, 0], queries.lower[b, 1], queries.lower[b, 2]
    x1, y1, z1 = queries.upper[b, 0], queries.upper[b, 1], queries.upper[b, 2]
    for g in range(len(points.group_lower)):
        dx = max(points.group_lower[g, 0] - x1, x0 - points.group_upper[g, 0], zero)
        dy = max(points.group_lower[g, 1] - y1, y0 - points.group_upper[g, 1], zero)
        dz = max(points.group_lower[g, 2] - z1, z0 - points.group_upper[g, 2], zero)
        if dx * dx + dy * dy + dz * dz > squared:
            continue
        for c in range(g * GROUP, min((g + 1) * GROUP, len(points.rows))):
            dx = max(points.lower[c, 0] - x1, x0 - points.upper[c, 0], zero)
            dy = max(points.lower[c, 1] - y1, y0 - points.upper[c, 1], zero)
            dz = max(points.lower[c, 2] - z1, z0 - points.upper[c, 2], zero)
            if dx * dx + dy * dy + dz * dz > squared:
                continue
            x, y, z = points.points[c, 0], points.points[c, 1], points.points[c, 2]
            for i in range(SIZE):
                dx = max(max(x[i] - x1, x0 - x[i]), zero)
                dy = max(max(y[i] - y1, y0 - y[i]), zero)
                dz = max(max(z[i] - z1, z0 - z[i]), zero)
                gaps[i] = dx * dx + dy * dy + dz * dz
            for i in range(min(SIZE, points.count - c * SIZE)):
                # Without a branch: written over by the next one where it is too far.
                places[n] = c * SIZE + i
                n += int(gaps[i] <= squared)
    return n
