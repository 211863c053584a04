"""Farthest point sampling: each point drawn is the one farthest from all that were drawn before it.

The first k of a longer sequence are the farthest points of that sequence (and of the cloud), so that the centroids of
all levels of a PointNet++ come from one call: each level takes the first ones of the level before.
"""

from __future__ import annotations

import fpsample
import numpy as np
import torch

from regnet_core.errors import InvalidInputError
from regnet_core.ops.gpu import has_kernels

_TREE_HEIGHT = 6
"""Height of fpsample's tree of buckets, measured the fastest for 25600 points; the result does not depend on it."""
_FEW = 512
"""Clouds of up to so many points are sampled without buckets, which need more points than 2 ** height."""


def farthest_points(points: torch.Tensor, count: int) -> torch.Tensor:
    """The indices of min(count, N) farthest points of (N, 3), in the order drawn -> int64.

    The first one is the same at each call, but which one it is differs between devices: fpsample starts at a point that
    its tree happens to sort first, whatever ``start_idx`` says.
    A cloud with fewer than ``count`` different points gives some of them again.

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
        return _sampled_on_cpu(points.detach(), count)
    if has_kernels(points):
        from regnet_core.ops.gpu.farthest_points import farthest_points_on_gpu

        return farthest_points_on_gpu(points.detach(), count)
    return farthest_points_in_torch(points.detach(), count)


def _sampled_on_cpu(points: torch.Tensor, count: int) -> torch.Tensor:
    array = np.ascontiguousarray(points.numpy(), np.float32)
    if len(array) <= _FEW:
        drawn = fpsample.fps_sampling(array, count, start_idx=0)
    else:
        drawn = fpsample.bucket_fps_kdline_sampling(array, count, h=_TREE_HEIGHT, start_idx=0)
    return torch.from_numpy(np.asarray(drawn, dtype=np.int64))


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
