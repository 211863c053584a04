"""Whether there is any point near others, which is found faster than the nearest one, and how far it is to the k-th."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.buckets import SIZE, Buckets, buckets_near_box
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


def kth_distance(points: Buckets, probes: int, k: int, usual: float, most: float) -> npt.NDArray[np.float32]:
    """(Q,): how far the k-th nearest of N points is from each of some of them, evenly along the buckets' curve [m].

    Args:
        points: N of them [m].
        probes: Q, but no more than N.
        k: which, from 1, where the point itself counts.
        usual: a distance that is a little too large, as a rule [m].
        most: what is farther is infinitely far [m].
    """
    distance = np.empty(min(probes, points.number), np.float32)
    for_each_range(_kth, len(distance), 3000, points, k, min(usual, most), most, distance)
    return distance


@compiled
def _kth(begin, end, buckets, k, usual, most, distance):  # type: ignore[no-untyped-def]
    found, nearest = np.empty(len(buckets.rows), np.int64), np.empty(k, np.float32)
    squares = np.empty((len(buckets.rows), SIZE), np.float32)
    for q in range(begin, end):
        own = buckets.number * q // len(distance)
        b, i = own // SIZE, own % SIZE
        x, y, z = buckets.points[b, 0, i], buckets.points[b, 1, i], buckets.points[b, 2, i]
        radius, distance[q] = usual, np.inf
        while True:
            reach = np.float32(radius * radius)
            there = buckets_near_box(buckets, x, y, z, x, y, z, reach, found)
            nearest[:] = np.inf
            for n in range(there):
                c = found[n]
                for j in range(SIZE):
                    dx, dy, dz = buckets.points[c, 0, j] - x, buckets.points[c, 1, j] - y, buckets.points[c, 2, j] - z
                    squares[n, j] = dx * dx + dy * dy + dz * dz
                for j in range(min(SIZE, buckets.number - c * SIZE)):
                    squared = squares[n, j]
                    if squared < nearest[k - 1]:
                        place = k - 1
                        while place > 0 and nearest[place - 1] > squared:
                            nearest[place] = nearest[place - 1]
                            place -= 1
                        nearest[place] = squared
            # Buckets reach farther than the ball: what they hold counts only up to its surface.
            if nearest[k - 1] <= reach:
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
