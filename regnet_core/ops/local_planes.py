"""The best-fitting plane of each point's neighbourhood: normals, roughness and denoised positions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled, compiled_with_any_order
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

    order = _order(grid, queries)

    def run(start: int, stop: int) -> None:
        _moments(
            queries, order, radius, grid.points, grid.start, grid.origin, grid.shape, grid.cell, start, stop,
            count, mean, cov,
        )  # fmt: skip

    for_each_range(run, len(queries))
    return LocalMoments(count, mean, cov)


def local_planes(grid: VoxelGrid, queries: Array, radius: float) -> LocalPlanes:
    """Fit a plane to the grid's points within ``radius`` [m] of each query (Q, 3)."""
    count = np.zeros(len(queries), np.int64)
    mean, cov = np.zeros((len(queries), 3)), np.zeros((len(queries), 3, 3))
    normal, roughness = np.zeros((len(queries), 3)), np.zeros(len(queries))

    order = _order(grid, queries)

    def run(start: int, stop: int) -> None:
        _moments(
            queries, order, radius, grid.points, grid.start, grid.origin, grid.shape, grid.cell, start, stop,
            count, mean, cov,
        )  # fmt: skip
        _least_axes(cov, order, start, stop, normal, roughness)

    for_each_range(run, len(queries))
    return LocalPlanes(mean, normal, roughness, count)


def _order(grid: VoxelGrid, queries: Array) -> npt.NDArray[np.int64]:
    """In which order to answer queries (Q, 3): any will do; where they are the grid's points, cell by cell is fast."""
    return grid.order if len(grid.order) == len(queries) else np.arange(len(queries))


@compiled
def _moments(queries, order, radius, points, starts, origin, shape, cell, begin, end, count, mean, cov):  # type: ignore[no-untyped-def]
    """The points of the cells around a query are put in a row of their own, which the next query uses too if it is in
    the same cell."""
    room = 512
    xs, ys, zs = np.empty(room), np.empty(room), np.empty(room)
    cells, n = (-1, -1, -1, -1, -1, -1), 0
    for place in range(begin, end):
        q = order[place]
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        i0, i1 = cell_range(x - radius, x + radius, origin[0], cell, shape[0])
        j0, j1 = cell_range(y - radius, y + radius, origin[1], cell, shape[1])
        k0, k1 = cell_range(z - radius, z + radius, origin[2], cell, shape[2])
        if k1 < k0:
            continue
        if (i0, i1, j0, j1, k0, k1) != cells:
            cells, n = (i0, i1, j0, j1, k0, k1), 0
            for i in range(i0, i1 + 1):
                for j in range(j0, j1 + 1):
                    row = (i * shape[1] + j) * shape[2]
                    first, last = starts[row + k0], starts[row + k1 + 1]
                    if n + last - first > room:
                        room = 2 * (n + last - first)
                        xs, ys, zs = _longer(xs, n, room), _longer(ys, n, room), _longer(zs, n, room)
                    for p in range(first, last):
                        xs[n], ys[n], zs[n] = points[p, 0], points[p, 1], points[p, 2]
                        n += 1
        m, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz = _sums(xs[:n], ys[:n], zs[:n], x, y, z, radius * radius)
        count[q] = int(m)
        if m == 0.0:
            continue
        mx, my, mz = sx / m, sy / m, sz / m
        mean[q, 0], mean[q, 1], mean[q, 2] = x + mx, y + my, z + mz
        cov[q, 0, 0] = sxx / m - mx * mx
        cov[q, 1, 1] = syy / m - my * my
        cov[q, 2, 2] = szz / m - mz * mz
        cov[q, 0, 1] = cov[q, 1, 0] = sxy / m - mx * my
        cov[q, 0, 2] = cov[q, 2, 0] = sxz / m - mx * mz
        cov[q, 1, 2] = cov[q, 2, 1] = syz / m - my * mz


@compiled
def _longer(values, n, room):  # type: ignore[no-untyped-def]
    longer = np.empty(room)
    longer[:n] = values[:n]
    return longer


@compiled_with_any_order
def _sums(xs, ys, zs, x, y, z, squared):  # type: ignore[no-untyped-def]
    """How many points are near enough, and the sums of their offsets and of the products of these."""
    m = sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    for p in range(len(xs)):
        dx, dy, dz = xs[p] - x, ys[p] - y, zs[p] - z
        near = 1.0 if dx * dx + dy * dy + dz * dz <= squared else 0.0
        m += near
        dx, dy, dz = near * dx, near * dy, near * dz
        sx += dx
        sy += dy
        sz += dz
        sxx += dx * dx
        sxy += dx * dy
        sxz += dx * dz
        syy += dy * dy
        syz += dy * dz
        szz += dz * dz
    return m, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz


@compiled
def _least_axes(tensors, order, begin, end, axis, root):  # type: ignore[no-untyped-def]
    """Unit eigenvectors of the least eigenvalues of symmetric tensors, and the roots of these, by Jacobi rotations."""
    a, v = np.empty((3, 3)), np.empty((3, 3))
    for place in range(begin, end):
        q = order[place]
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
