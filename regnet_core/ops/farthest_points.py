"""Farthest point sampling: each point drawn is the one farthest from all that were drawn before it.

The first k of a longer sequence are the farthest points of that sequence (and of the cloud), so that the centroids of
all levels of a PointNet++ come from one call: each level takes the first ones of the level before.
"""

from __future__ import annotations

import numpy as np
import torch

from regnet_core.errors import InvalidInputError
from regnet_core.ops.buckets import BOX_BYTES, BUCKET_BYTES, GROUP, SIZE, Buckets, point_buckets
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels
from regnet_core.ops.lanes import boxes_with, boxes_within, draw, largest_of_boxes, lowest_bit, points_with


def farthest_points(points: torch.Tensor, count: int, buckets: Buckets | None = None) -> torch.Tensor:
    """The indices of min(count, N) farthest points of a cloud, in the order drawn -> int64; the first one is 0.

    Of points that are equally far the first one in the cloud is drawn. A cloud with fewer than ``count`` different
    points gives some of them again.

    Args:
        points: (N, 3) [m].
        count: how many.
        buckets: of the points, from ``point_buckets``, where there are some already.

    Raises:
        InvalidInputError: the count is negative, or points are not (N, 3).
    """
    if count < 0:
        raise InvalidInputError(f"the number of farthest points must be 0 or more, got {count}")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InvalidInputError(f"points must have the shape (N, 3), got {tuple(points.shape)}")
    count = min(count, len(points))
    if count == 0:
        return torch.zeros(0, dtype=torch.int64, device=points.device)
    if points.device.type == "cpu":
        return _sampled_on_cpu(points.detach(), count, buckets)
    if has_kernels(points):
        from regnet_core.ops.gpu.farthest_points import farthest_points_on_gpu

        return farthest_points_on_gpu(points.detach(), count)
    return farthest_points_in_torch(points.detach(), count)


def _sampled_on_cpu(points: torch.Tensor, count: int, buckets: Buckets | None) -> torch.Tensor:
    drawn = np.empty(count, np.int64)
    _draw(buckets or point_buckets(points), points.float().numpy(), drawn)
    return torch.from_numpy(drawn)


def farthest_points_in_torch(points: torch.Tensor, count: int, start: int = 0) -> torch.Tensor:
    """The same on any device, for 0 < count <= N, from a given start; one step for each point drawn."""
    drawn = torch.full((count,), start, dtype=torch.int64, device=points.device)
    nearest = torch.full((len(points),), torch.inf, dtype=points.dtype, device=points.device)
    for i in range(1, count):
        # No index leaves the device: nothing waits for the step to end.
        last = points.index_select(0, drawn[i - 1 : i])
        nearest = torch.minimum(nearest, (points - last).square().sum(dim=1))
        drawn[i] = nearest.argmax()
    return drawn


@compiled
def _draw(buckets, points, drawn):  # type: ignore[no-untyped-def]
    """Only in buckets that have points farther from all drawn ones than from the last one does anything change."""
    known = np.full(buckets.rows.shape, np.float32(np.inf))
    # The farthest of each bucket and each group; those that are not there stay at 0.
    farthest = np.zeros((len(buckets.boxes), GROUP), np.float32)
    of_groups = np.zeros((len(buckets.groups), GROUP), np.float32)
    for b in range(len(known)):
        farthest[b // GROUP, b % GROUP] = np.inf
    for g in range(len(farthest)):
        of_groups[g // GROUP, g % GROUP] = np.inf
    groups, boxes, at = buckets.groups.ctypes.data, buckets.boxes.ctypes.data, buckets.points.ctypes.data
    limits, limits_of_groups, distances = farthest.ctypes.data, of_groups.ctypes.data, known.ctypes.data
    row, values = GROUP * 4, SIZE * 4
    last = np.int64(0)
    for n in range(len(drawn)):
        drawn[n] = last
        x, y, z = points[last, 0], points[last, 1], points[last, 2]
        top = np.float32(0.0)
        for s in range(len(of_groups)):
            some = boxes_within(groups + s * BOX_BYTES, limits_of_groups + s * row, x, y, z)
            while some != 0:
                g = s * GROUP + lowest_bit(some)
                some &= some - 1
                own = boxes_within(boxes + g * BOX_BYTES, limits + g * row, x, y, z)
                while own != 0:
                    b = g * GROUP + lowest_bit(own)
                    own &= own - 1
                    farthest[g, b % GROUP] = draw(at + b * BUCKET_BYTES, distances + b * values, x, y, z)
                of_groups[s, g % GROUP] = largest_of_boxes(limits + g * row)
            top = max(top, largest_of_boxes(limits_of_groups + s * row))
        last = np.int64(len(points))
        for s in range(len(of_groups)):
            some = boxes_with(limits_of_groups + s * row, top)
            while some != 0:
                g = s * GROUP + lowest_bit(some)
                some &= some - 1
                if g >= len(farthest):
                    break
                own = boxes_with(limits + g * row, top)
                while own != 0:
                    b = g * GROUP + lowest_bit(own)
                    own &= own - 1
                    if b >= len(known):
                        break
                    equal = points_with(distances + b * values, top)
                    while equal != 0:
                        last = min(last, np.int64(buckets.rows[b, lowest_bit(equal)]))
                        equal &= equal - 1
