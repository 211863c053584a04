"""Points in small buckets of neighbours: what is asked of one point of a bucket is asked of all of them at a time.

A bucket has as many points as fill a few registers, so that compiled loops over it become a few instructions, and a
box around it, so that most of the other points are passed over without a look at them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.ops.compiled import compiled, inlined
from regnet_core.ops.lanes import BOXES, POINTS, boxes_near_box, lowest_bit, near_box
from regnet_core.ops.voxel_grid import bounds_loop

if TYPE_CHECKING:
    import torch

SIZE, GROUP = POINTS, BOXES
"""Points of a bucket; buckets of a group, and groups that are looked at together."""
BOX_BYTES, BUCKET_BYTES = 4 * 6 * GROUP, 4 * 3 * SIZE
"""From one group's boxes to the next one's; from one bucket's points to the next one's."""
_BITS = 8
"""Of the number of a cell along an axis, by which points are sorted."""


class Buckets(NamedTuple):
    """N points along a curve that stays in small cubes (Morton's), in B buckets of ``SIZE`` and G groups of these.

    The last bucket is filled up with its last point, groups with boxes that nothing is near.
    """

    points: npt.NDArray[np.float32]
    """(B, 3, SIZE): the x of a bucket's points, then their y, then their z [m]."""
    rows: npt.NDArray[np.int32]
    """(B, SIZE): which row of the input each of them is."""
    boxes: npt.NDArray[np.float32]
    """(G, 6, GROUP): bounding boxes of buckets, the x, y, z of their lower corners and of their upper ones [m]."""
    groups: npt.NDArray[np.float32]
    """(ceil(G / GROUP), 6, GROUP): those of groups [m]."""
    number: int
    """N."""


def in_buckets(points: npt.NDArray[np.float32]) -> Buckets:
    """Sort finite points (N, 3) [m] into buckets."""
    count = len(points)
    number = -(-count // SIZE)
    groups = -(-number // GROUP)
    made = Buckets(
        np.empty((number, 3, SIZE), np.float32),
        np.empty((number, SIZE), np.int32),
        np.empty((groups, 6, GROUP), np.float32),
        np.empty((-(-groups // GROUP), 6, GROUP), np.float32),
        count,
    )
    if count:
        _fill(np.ascontiguousarray(points), made)
    return made


class CornerBuckets(NamedTuple):
    """Points in buckets as they are seen from the lower corner of their bounding box: float32 loses little of that."""

    buckets: Buckets
    corner: npt.NDArray[np.float64]
    """(3,) [m]."""

    @classmethod
    def of(cls, points: npt.NDArray[np.floating]) -> CornerBuckets:
        """Of finite points (N, 3) [m]."""
        if len(points) == 0:
            return cls(in_buckets(np.zeros((0, 3), np.float32)), np.zeros(3))
        moved, corner = _from_corner(np.ascontiguousarray(points))
        return cls(in_buckets(moved), corner)


def point_buckets(points: torch.Tensor) -> Buckets | None:
    """Buckets for several searches of the same points (N, 3) on a CPU; None elsewhere, where none uses them."""
    return in_buckets(points.detach().float().numpy()) if points.device.type == "cpu" else None


@compiled
def _from_corner(points):  # type: ignore[no-untyped-def]
    """The points as seen from the lower corner of their bounding box, and that corner."""
    corner, moved = bounds_loop(points)[0].astype(np.float64), np.empty(points.shape, np.float32)
    for p in range(len(points)):
        for a in range(3):
            moved[p, a] = points[p, a] - corner[a]
    return moved, corner


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
def _fill(points, made):  # type: ignore[no-untyped-def]
    lower, upper = bounds_loop(points)
    extent = max((upper - lower).max(), np.float32(1e-6))
    order = _along_the_curve(points, lower, np.float32((1 << _BITS) / extent))
    for boxes in (made.boxes, made.groups):  # nowhere
        boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
    last = len(order) - 1
    for b in range(len(made.rows)):
        g, place = b // GROUP, b % GROUP
        for i in range(SIZE):
            row = order[min(b * SIZE + i, last)]
            made.rows[b, i] = row
            for a in range(3):
                made.points[b, a, i] = points[row, a]
        group = made.groups[g // GROUP]
        for a in range(3):
            low, high = made.points[b, a].min(), made.points[b, a].max()
            made.boxes[g, a, place], made.boxes[g, 3 + a, place] = low, high
            group[a, g % GROUP] = min(group[a, g % GROUP], low)
            group[3 + a, g % GROUP] = max(group[3 + a, g % GROUP], high)


@inlined
def buckets_near_box(buckets, x0, y0, z0, x1, y1, z1, squared, found):  # type: ignore[no-untyped-def]
    """Write down the buckets within a distance, of which the square is given, of a box; and say how many these are."""
    n, groups, boxes = 0, buckets.groups.ctypes.data, buckets.boxes.ctypes.data
    for s in range(len(buckets.groups)):
        some = boxes_near_box(groups + s * BOX_BYTES, x0, y0, z0, x1, y1, z1, squared)
        while some != 0:
            g = s * GROUP + lowest_bit(some)
            some &= some - 1
            own = boxes_near_box(boxes + g * BOX_BYTES, x0, y0, z0, x1, y1, z1, squared)
            while own != 0:
                found[n] = g * GROUP + lowest_bit(own)
                own &= own - 1
                n += 1
    return n


@inlined
def own_bits(buckets, b):  # type: ignore[no-untyped-def]
    """A bit for each point of bucket ``b`` that is not there to fill it up."""
    left = buckets.number - b * SIZE
    return (1 << SIZE) - 1 if left >= SIZE else (1 << left) - 1


@inlined
def near_bucket(queries, b, points, squared, found, places):  # type: ignore[no-untyped-def]
    """Write down which points lie within a distance of bucket ``b``'s box, and say how many these are.

    ``squared`` is the distance's square; ``found`` has room for all buckets; ``places`` has room for all points, and
    gets SIZE * bucket + place in the bucket.
    """
    g, place = b // GROUP, b % GROUP
    x0, y0, z0 = queries.boxes[g, 0, place], queries.boxes[g, 1, place], queries.boxes[g, 2, place]
    x1, y1, z1 = queries.boxes[g, 3, place], queries.boxes[g, 4, place], queries.boxes[g, 5, place]
    n, at = 0, points.points.ctypes.data
    for k in range(buckets_near_box(points, x0, y0, z0, x1, y1, z1, squared, found)):
        c = found[k]
        some = near_box(at + c * BUCKET_BYTES, x0, y0, z0, x1, y1, z1, squared) & own_bits(points, c)
        while some != 0:
            places[n] = c * SIZE + lowest_bit(some)
            some &= some - 1
            n += 1
    return n
