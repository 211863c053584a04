"""Ball query: the points within a radius of each centre (PointNet++, section 3.2), at most K of them, without padding.

Of more than K points, those that come first in the cloud are kept. Clouds are drawn at random and centroids come in
the order of farthest point sampling, so that the first ones are spread over the whole ball; the nearest ones would
shrink it.
"""

from __future__ import annotations

import numpy as np
import torch

from regnet_core.checks import check_range
from regnet_core.errors import InvalidInputError
from regnet_core.ops.buckets import BUCKET_BYTES, Buckets, buckets_near_box, in_buckets, own_bits
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels
from regnet_core.ops.lanes import in_ball, lowest_bit
from regnet_core.ops.neighbourhoods import Neighbourhoods, collect, from_mask, keep_first

_CHUNK = 1 << 24
"""Pairs of a centre and a point that the search in torch looks at in one go."""


def ball_query(
    points: torch.Tensor, centres: torch.Tensor, radius: float, most: int, buckets: Buckets | None = None
) -> Neighbourhoods:
    """The points of one cloud in the ball around each centre.

    Args:
        points: (N, 3).
        centres: (C, 3).
        radius: of the balls, their surface included [m].
        most: K, the most neighbours of a centre; of more, the first K in the order of the points.
        buckets: of the points, from ``point_buckets``, where there are some already.

    Raises:
        InvalidInputError: the radius or K is not positive, or an array has another shape.
    """
    check_range("most", most, 1)
    if not radius > 0.0:
        raise InvalidInputError(f"the radius of a ball query must be above 0 m, got {radius:g}")
    for name, array in (("points", points), ("centres", centres)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise InvalidInputError(f"{name} must have the shape (n, 3), got {tuple(array.shape)}")
    if points.device.type == "cpu":
        return _queried_on_cpu(points.detach(), centres.detach(), radius, most, buckets)
    if has_kernels(points):
        from regnet_core.ops.gpu.queries import ball_query_on_gpu

        return ball_query_on_gpu(points.detach(), centres.detach(), radius, most)
    return ball_query_in_torch(points.detach(), centres.detach(), radius, most)


def _queried_on_cpu(
    points: torch.Tensor, centres: torch.Tensor, radius: float, most: int, buckets: Buckets | None
) -> Neighbourhoods:
    given, queries = buckets or in_buckets(points.float().numpy()), centres.float().numpy()
    return collect(_search, len(queries), most, 700, queries, radius, given)


def ball_query_in_torch(points: torch.Tensor, centres: torch.Tensor, radius: float, most: int) -> Neighbourhoods:
    """The same on any device: every centre is compared with every point."""
    step = max(1, _CHUNK // max(1, len(points)))
    parts = [from_mask(_within(points, some, radius), most) for some in centres.split(step)]
    if not parts:
        return from_mask(torch.zeros((0, len(points)), dtype=torch.bool, device=points.device), most)
    counts = torch.cat([part.counts for part in parts])
    offsets = torch.zeros(len(counts) + 1, dtype=torch.int64, device=points.device)
    torch.cumsum(counts, 0, out=offsets[1:])
    return Neighbourhoods(torch.cat([part.indices for part in parts]), offsets)


def _within(points: torch.Tensor, centres: torch.Tensor, radius: float) -> torch.Tensor:
    squared = torch.zeros((len(centres), len(points)), dtype=torch.float64, device=points.device)
    for axis in range(3):
        squared += (centres[:, axis, None].double() - points[None, :, axis].double()).square()
    return squared <= radius * radius


@compiled
def _search(begin, end, queries, radius, points, counts, found):  # type: ignore[no-untyped-def]
    near, buckets, at = (
        np.empty(points.number, np.int32),
        np.empty(len(points.rows), np.int64),
        points.points.ctypes.data,
    )
    exact = radius * radius
    # float32 is sure of all points but those next to the surface.
    inside, perhaps = np.float32(exact * (1.0 - 1e-5)), np.float32(exact * (1.0 + 1e-5))
    for q in range(begin, end):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        n = 0
        for k in range(buckets_near_box(points, x, y, z, x, y, z, perhaps, buckets)):
            b = buckets[k]
            some = in_ball(at + b * BUCKET_BYTES, x, y, z, perhaps) & own_bits(points, b)
            sure = in_ball(at + b * BUCKET_BYTES, x, y, z, inside)
            while some != 0:
                i = lowest_bit(some)
                some &= some - 1
                near[n] = points.rows[b, i]
                if (sure >> i) & 1:
                    n += 1
                else:
                    dx = np.float64(points.points[b, 0, i]) - x
                    dy = np.float64(points.points[b, 1, i]) - y
                    dz = np.float64(points.points[b, 2, i]) - z
                    n += int(dx * dx + dy * dy + dz * dz <= exact)
        keep_first(near, n, q, counts, found)
