"""Farthest point sampling: each point drawn is the one farthest from all that were drawn before it.

The first k of a longer sequence are the farthest points of that sequence (and of the cloud), so that the centroids of
all levels of a PointNet++ come from one call: each level takes the first ones of the level before.
"""

from __future__ import annotations

import numpy as np
import torch

from regnet_core.errors import InvalidInputError
from regnet_core.ops.buckets import GROUP, SIZE, Buckets, gap_to_box, point_buckets
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels


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
    count, groups = len(buckets.rows), len(buckets.group_lower)
    infinity, zero = np.float32(np.inf), np.float32(0.0)
    # Squared distances to what has been drawn: of each point, and the farthest of each bucket and each group.
    nearest = np.full((count, SIZE), infinity)
    farthest, farthest_of_group = np.full(count, infinity), np.full(groups, infinity)
    # The bits of numbers that are not below 0 are in the order of the numbers, and the largest of several whole
    # numbers is found at a time.
    nearest_bits, farthest_bits = nearest.view(np.int32), farthest.view(np.int32)
    last = 0
    for n in range(len(drawn)):
        drawn[n] = last
        x, y, z = points[last, 0], points[last, 1], points[last, 2]
        top = zero
        for g in range(groups):
            if gap_to_box(buckets.group_lower, buckets.group_upper, g, x, y, z) < farthest_of_group[g]:
                best = zero
                for b in range(g * GROUP, min((g + 1) * GROUP, count)):
                    if gap_to_box(buckets.lower, buckets.upper, b, x, y, z) < farthest[b]:
                        px, py, pz = buckets.points[b, 0], buckets.points[b, 1], buckets.points[b, 2]
                        known, bits, most = nearest[b], nearest_bits[b], np.int32(0)
                        for i in range(SIZE):
                            dx, dy, dz = px[i] - x, py[i] - y, pz[i] - z
                            squared, before = dx * dx + dy * dy + dz * dz, known[i]
                            known[i] = squared if squared < before else before
                            own = bits[i]
                            most = own if own > most else most
                        farthest_bits[b] = most
                    best = max(best, farthest[b])
                farthest_of_group[g] = best
            top = max(top, farthest_of_group[g])
        last = len(points)
        for g in range(groups):
            if farthest_of_group[g] == top:
                for b in range(g * GROUP, min((g + 1) * GROUP, count)):
                    if farthest[b] == top:
                        for i in range(SIZE):
                            if nearest[b, i] == top:
                                last = min(last, buckets.rows[b, i])
