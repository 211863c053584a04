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
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels
from regnet_core.ops.neighbourhoods import Neighbourhoods, collect, from_mask, keep_first
from regnet_core.ops.voxel_grid import VoxelGrid, build_grid, cell_range

_CHUNK = 1 << 24
"""Pairs of a centre and a point that the search in torch looks at in one go."""


def point_grid(points: torch.Tensor, cell: float) -> VoxelGrid | None:
    """A grid for several queries of the same points (N, 3) on a CPU; None elsewhere, where no query uses one."""
    if points.device.type != "cpu":
        return None
    return build_grid(points.detach().numpy().astype(np.float64), cell)


def ball_query(
    points: torch.Tensor, centres: torch.Tensor, radius: float, most: int, grid: VoxelGrid | None = None
) -> Neighbourhoods:
    """The points of one cloud in the ball around each centre.

    Args:
        points: (N, 3).
        centres: (C, 3).
        radius: of the balls, their surface included [m].
        most: K, the most neighbours of a centre; of more, the first K in the order of the points.
        grid: of the points, from ``point_grid``, where there is one already.

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
        return _queried_on_cpu(points.detach(), centres.detach(), radius, most, grid)
    if has_kernels(points):
        from regnet_core.ops.gpu.queries import ball_query_on_gpu

        return ball_query_on_gpu(points.detach(), centres.detach(), radius, most)
    return ball_query_in_torch(points.detach(), centres.detach(), radius, most)


def _queried_on_cpu(
    points: torch.Tensor, centres: torch.Tensor, radius: float, most: int, grid: VoxelGrid | None
) -> Neighbourhoods:
    cells = grid or build_grid(points.numpy().astype(np.float64), radius)
    queries = centres.numpy().astype(np.float64)

    def search(start, stop, counts, found):  # type: ignore[no-untyped-def]
        _search(
            queries, radius, cells.points, cells.order, cells.start, cells.origin, cells.shape, cells.cell,
            start, stop, counts, found,
        )  # fmt: skip

    return collect(search, len(queries), most)


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
def _search(queries, radius, points, order, starts, origin, shape, cell, begin, end, counts, found):  # type: ignore[no-untyped-def]
    near = np.empty(len(points) + 1, np.int32)
    squared = radius * radius
    for q in range(begin, end):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        n = 0
        i0, i1 = cell_range(x - radius, x + radius, origin[0], cell, shape[0])
        j0, j1 = cell_range(y - radius, y + radius, origin[1], cell, shape[1])
        k0, k1 = cell_range(z - radius, z + radius, origin[2], cell, shape[2])
        if k1 < k0:
            continue
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                row = (i * shape[1] + j) * shape[2]
                for p in range(starts[row + k0], starts[row + k1 + 1]):
                    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    # Without a branch: written over by the next one where it is too far.
                    near[n] = order[p]
                    n += int(dx * dx + dy * dy + dz * dz <= squared)
        keep_first(near, n, q, counts, found)
