"""The best-fitting plane of each point's neighbourhood: normals, roughness and denoised positions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import VoxelGrid, cell_range


class LocalPlanes(NamedTuple):
    """For each of Q query points."""

    mean: Array
    """(Q, 3): centroid of the neighbours [m]."""
    normal: Array
    """(Q, 3): direction of least variance, of arbitrary sign."""
    roughness: Array
    """(Q,): standard deviation of the neighbours along the normal [m]."""
    neighbours: npt.NDArray[np.int64]
    """(Q,): number of neighbours, the point itself included."""


class LocalMoments(NamedTuple):
    """For each of Q query points."""

    neighbours: npt.NDArray[np.int64]
    """(Q,): number of neighbours, the point itself included."""
    mean: Array
    """(Q, 3): centroid of the neighbours [m]."""
    covariance: Array
    """(Q, 3, 3) of the neighbours [m2]."""


def local_moments(grid: VoxelGrid, queries: Array, radius: float) -> LocalMoments:
    """Mean and covariance of the grid's points within ``radius`` [m] of each query (Q, 3)."""
    count = np.zeros(len(queries), np.int64)
    mean, cov = np.zeros((len(queries), 3)), np.zeros((len(queries), 3, 3))

    def run(start: int, stop: int) -> None:
        _moments(
            queries, radius, grid.points, grid.start, grid.origin, grid.shape, grid.cell, start, stop, count, mean, cov
        )

    for_each_range(run, len(queries))
    return LocalMoments(count, mean, cov)


def local_planes(grid: VoxelGrid, queries: Array, radius: float) -> LocalPlanes:
    """Fit a plane to the grid's points within ``radius`` [m] of each query (Q, 3)."""
    count = np.zeros(len(queries), np.int64)
    mean, cov = np.zeros((len(queries), 3)), np.zeros((len(queries), 3, 3))
    normal, roughness = np.zeros((len(queries), 3)), np.zeros(len(queries))

    def run(start: int, stop: int) -> None:
        _moments(
            queries, radius, grid.points, grid.start, grid.origin, grid.shape, grid.cell, start, stop, count, mean, cov
        )
        values, vectors = np.linalg.eigh(cov[start:stop])  # releases the GIL too
        normal[start:stop] = vectors[:, :, 0]
        roughness[start:stop] = np.sqrt(np.maximum(values[:, 0], 0.0))

    for_each_range(run, len(queries))
    return LocalPlanes(mean, normal, roughness, count)


@compiled
def _moments(queries, radius, points, starts, origin, shape, cell, begin, end, count, mean, cov):  # type: ignore[no-untyped-def]
    for q in range(begin, end):
        x, y, z = queries[q]
        n = 0
        sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
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
                    if dx * dx + dy * dy + dz * dz > radius * radius:
                        continue
                    n += 1
                    sx += dx
                    sy += dy
                    sz += dz
                    sxx += dx * dx
                    sxy += dx * dy
                    sxz += dx * dz
                    syy += dy * dy
                    syz += dy * dz
                    szz += dz * dz
        count[q] = n
        if n == 0:
            continue
        mx, my, mz = sx / n, sy / n, sz / n
        mean[q] = x + mx, y + my, z + mz
        cov[q, 0, 0] = sxx / n - mx * mx
        cov[q, 1, 1] = syy / n - my * my
        cov[q, 2, 2] = szz / n - mz * mz
        cov[q, 0, 1] = cov[q, 1, 0] = sxy / n - mx * my
        cov[q, 0, 2] = cov[q, 2, 0] = sxz / n - mx * mz
        cov[q, 1, 2] = cov[q, 2, 1] = syz / n - my * mz
