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
from regnet_core.ops.buckets import GROUP, SIZE, Buckets, gap_to_box, in_buckets
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels
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
    return collect(
        lambda start, stop, counts, found: _search(queries, radius, given, start, stop, counts, found),
        len(queries),
        most,
    )


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
def _search(queries, radius, points, begin, end, counts, found):  # type: ignore[no-untyped-def]
    near, gaps = np.empty(points.count + SIZE, np.int32), np.empty(SIZE, np.float32)
    exact = radius * radius
    # float32 is sure of all points but those next to the surface.
    inside, perhaps = np.float32(exact * (1.0 - 1e-5)), np.float32(exact * (1.0 + 1e-5))
    for q in range(begin, end):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        n = 0
        for g in range(len(points.group_lower)):
            if gap_to_box(points.group_lower, points.group_upper, g, x, y, z) > perhaps:
                continue
            for b in range(g * GROUP, min((g + 1) * GROUP, len(points.rows))):
                if gap_to_box(points.lower, points.upper, b, x, y, z) > perhaps:
                    continue
                px, py, pz, rows = points.points[b, 0], points.points[b, 1], points.points[b, 2], points.rows[b]
                unsure = np.int32(0)
                for i in range(SIZE):
                    dx, dy, dz = px[i] - x, py[i] - y, pz[i] - z
                    gap = dx * dx + dy * dy + dz * dz
                    gaps[i] = gap
                    unsure += np.int32((gap > inside) & (gap <= perhaps))
                if unsure:
                    for i in range(SIZE):
                        dx, dy, dz = np.float64(px[i]) - x, np.float64(py[i]) - y, np.float64(pz[i]) - z
                        gaps[i] = np.float32(0.0) if dx * dx + dy * dy + dz * dz <= exact else np.float32(np.inf)
                for i in range(min(SIZE, points.count - b * SIZE)):
                    # Without a branch: written over by the next one where it is too far.
                    near[n] = rows[i]
                    n += int(gaps[i] <= perhaps)
        keep_first(near, n, q, counts, found)
