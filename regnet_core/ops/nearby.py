"""Whether there is any point near others, which is found faster than the nearest one, and how far it is to the k-th."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.buckets import SIZE, Buckets, buckets_near_box
from regnet_core.ops.cell_points import points_in_cells
from regnet_core.ops.compiled import compiled
from regnet_core.ops.lanes import BOXES, in_ball_apart
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import cell_range

_CELL = 0.012
"""Edge length of the cells that points are sorted into, at least [m]: smaller ones take more time than they save."""


def near_any(points: Array, queries: Array, radius: float) -> npt.NDArray[np.bool_]:
    """(Q,): whether any of the points (N, 3) is within the radius of each query (Q, 3) [m].

    Distances are computed in float32, from the lower corner of the points' bounding box.
    """
    near = np.zeros(len(queries), np.bool_)
    if len(points) > 0:
        cells, at = points_in_cells(points, max(radius, _CELL)), np.ascontiguousarray(queries, np.float64)
        for_each_range(_search, len(at), 25, at, radius, *cells, near)
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
def _search(begin, end, queries, radius, at, start, low, cell, near):  # type: ignore[no-untyped-def]
    nx, ny = start.shape[0], start.shape[1] - 1
    squared, address, apart = np.float32(radius * radius), at.ctypes.data, 4 * at.shape[1]
    for q in range(begin, end):
        x, y, z = queries[q, 0] - low[0], queries[q, 1] - low[1], queries[q, 2] - low[2]
        i0, i1 = cell_range(x - radius, x + radius, 0.0, cell, nx)
        j0, j1 = cell_range(y - radius, y + radius, 0.0, cell, ny)
        found = 0
        if j0 <= j1:
            for i in range(i0, i1 + 1):
                # Who is looked at too much, from the cells behind, is near or is not, like the others.
                for p in range(start[i, j0], start[i, j1 + 1], BOXES):
                    found |= in_ball_apart(address + 4 * p, apart, np.float32(x), np.float32(y), np.float32(z), squared)
        near[q] = found != 0
