"""Whether there is any point near others, which is found faster than the nearest one, and how far it is to the k-th."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import build_grid, cell_range

_SMALLEST = 0.012
"""Edge length of the grid's cells at least [m]: smaller ones take more time to make than they save."""


def near_any(points: Array, queries: Array, radius: float) -> npt.NDArray[np.bool_]:
    """(Q,): whether any of the points (N, 3) is within the radius of each query (Q, 3) [m]."""
    near = np.zeros(len(queries), np.bool_)
    grid = build_grid(np.asarray(points, np.float64), max(radius, _SMALLEST))
    at = np.ascontiguousarray(queries, np.float64)

    places = (grid.points, grid.start, grid.origin, grid.shape, grid.cell)
    for_each_range(_search, len(at), 35, at, radius, *places, near)
    return near


def kth_distance(points: Array, queries: Array, k: int, usual: float, most: float) -> Array:
    """(Q,): how far the k-th nearest of the points (N, 3) is from each query (Q, 3) [m].

    Args:
        points: (N, 3) [m].
        queries: (Q, 3) [m].
        k: which, from 1; a query that is one of the points counts.
        usual: a distance that is about right [m].
        most: what is farther is infinitely far [m].
    """
    distance = np.full(len(queries), np.inf)
    grid = build_grid(np.asarray(points, np.float64), usual)
    at = np.ascontiguousarray(queries, np.float64)

    places = (grid.points, grid.start, grid.origin, grid.shape, grid.cell)
    for_each_range(_kth, len(at), 3700, at, k, usual, most, *places, distance)
    return distance


@compiled
def _kth(begin, end, queries, k, usual, most, points, starts, origin, shape, cell, distance):  # type: ignore[no-untyped-def]
    nearest = np.empty(k)
    for q in range(begin, end):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        radius = min(usual, most)
        while True:
            nearest[:] = np.inf
            i0, i1 = cell_range(x - radius, x + radius, origin[0], cell, shape[0])
            j0, j1 = cell_range(y - radius, y + radius, origin[1], cell, shape[1])
            k0, k1 = cell_range(z - radius, z + radius, origin[2], cell, shape[2])
            if k1 >= k0:
                for i in range(i0, i1 + 1):
                    for j in range(j0, j1 + 1):
                        row = (i * shape[1] + j) * shape[2]
                        for p in range(starts[row + k0], starts[row + k1 + 1]):
                            dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                            squared = dx * dx + dy * dy + dz * dz
                            if squared < nearest[k - 1]:
                                place = k - 1
                                while place > 0 and nearest[place - 1] > squared:
                                    nearest[place] = nearest[place - 1]
                                    place -= 1
                                nearest[place] = squared
            # Cells reach farther than the ball: what they hold counts only up to its surface.
            if nearest[k - 1] <= radius * radius:
                distance[q] = np.sqrt(nearest[k - 1])
                break
            if radius >= most:
                break
            radius = min(1.5 * radius, most)


@compiled
def _search(begin, end, queries, radius, points, starts, origin, shape, cell, near):  # type: ignore[no-untyped-def]
    for q in range(begin, end):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        i0, i1 = cell_range(x - radius, x + radius, origin[0], cell, shape[0])
        j0, j1 = cell_range(y - radius, y + radius, origin[1], cell, shape[1])
        k0, k1 = cell_range(z - radius, z + radius, origin[2], cell, shape[2])
        found = False
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                if found or k1 < k0:
                    break
                row = (i * shape[1] + j) * shape[2]
                for p in range(starts[row + k0], starts[row + k1 + 1]):
                    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    if dx * dx + dy * dy + dz * dz <= radius * radius:
                        found = True
                        break
        near[q] = found
