"""Local reference frames of a surface: its normal and the axis about which it bends least (ten Pas et al., 2017).

Of the normals n within a radius, the matrix of products sum n n^T has the surface's normal as the eigenvector of the
largest eigenvalue, and the axis of least curvature, along which normals do not turn, as that of the smallest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import VoxelGrid, cell_range


class LocalFrames(NamedTuple):
    """For each of Q points; the three vectors are perpendicular and right-handed: binormal = axis x normal."""

    normal: Array
    """(Q, 3): outward."""
    binormal: Array
    """(Q, 3): the direction in which the surface bends most."""
    axis: Array
    """(Q, 3): the direction in which it bends least; its sign is arbitrary, and on a plane so is the axis."""
    neighbours: npt.NDArray[np.int64]
    """(Q,): how many points it was computed from; without any the vectors are the frame's own axes."""


def local_frames(grid: VoxelGrid, normals: Array, queries: Array, radius: float) -> LocalFrames:
    """The frames at points (Q, 3) from the grid's points within ``radius`` [m] of each.

    Args:
        grid: surface points.
        normals: (S, 3) outward, of length 1, in the order of ``grid.points``.
        queries: (Q, 3) [m].
        radius: of the neighbourhoods [m].
    """
    products, total = np.zeros((len(queries), 3, 3)), np.zeros((len(queries), 3))
    count = np.zeros(len(queries), np.int64)

    for_each_range(
        _sum_products, len(queries), 1500,
        queries, radius, grid.points, normals, grid.start, grid.origin, grid.shape, grid.cell, products, total, count,
    )  # fmt: skip
    vectors = np.linalg.eigh(products)[1]
    axis, normal = vectors[:, :, 0], vectors[:, :, 2]
    inward = np.einsum("qi,qi->q", normal, total) < 0.0
    normal = np.where(inward[:, None], -normal, normal)
    return LocalFrames(normal, np.cross(axis, normal), axis, count)


@compiled
def _sum_products(  # type: ignore[no-untyped-def]
    begin, end, queries, radius, points, normals, starts, origin, shape, cell, products, total, count
):
    for q in range(begin, end):
        x, y, z = queries[q]
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
                    count[q] += 1
                    for a in range(3):
                        total[q, a] += normals[p, a]
                        for b in range(3):
                            products[q, a, b] += normals[p, a] * normals[p, b]
