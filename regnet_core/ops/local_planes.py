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
        _least_axes(cov, start, stop, normal, roughness)

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


@compiled
def _least_axes(tensors, begin, end, axis, root):  # type: ignore[no-untyped-def]
    """Unit eigenvectors of the least eigenvalues of symmetric tensors, and the roots of these, by Jacobi rotations."""
    a, v = np.empty((3, 3)), np.empty((3, 3))
    for q in range(begin, end):
        size = 0.0
        for i in range(3):
            for j in range(3):
                a[i, j] = tensors[q, i, j]
                v[i, j] = 1.0 if i == j else 0.0
                size += a[i, j] * a[i, j]
        for _ in range(12):  # four or five are enough
            if a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2] + a[1, 2] * a[1, 2] <= 1e-30 * size:
                break
            for i in range(2):
                for j in range(i + 1, 3):
                    if a[i, j] == 0.0:
                        continue
                    theta = (a[j, j] - a[i, i]) / (2.0 * a[i, j])
                    t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                    c = 1.0 / np.sqrt(t * t + 1.0)
                    s = t * c
                    k = 3 - i - j
                    a[i, i], a[j, j] = a[i, i] - t * a[i, j], a[j, j] + t * a[i, j]
                    a[i, k], a[j, k] = c * a[i, k] - s * a[j, k], s * a[i, k] + c * a[j, k]
                    a[k, i], a[k, j] = a[i, k], a[j, k]
                    a[i, j] = a[j, i] = 0.0
                    for r in range(3):
                        v[r, i], v[r, j] = c * v[r, i] - s * v[r, j], s * v[r, i] + c * v[r, j]
        least = 0
        for i in range(1, 3):
            if a[i, i] < a[least, least]:
                least = i
        for r in range(3):
            axis[q, r] = v[r, least]
        root[q] = np.sqrt(max(a[least, least], 0.0))
