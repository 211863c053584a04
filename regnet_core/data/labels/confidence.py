"""Point grasp confidence, eq. (1) of REGNet V2: how well a point is suited to grasping.

A point's confidence is tanh of the sum of the scores of the grasps within d_th of it. A grasp's place is its entry
point, where the approach axis meets the object: the grasp centre c can be 3 cm above a low object. The sum grows with
the number of grasps that were sampled, and a place that can be grasped from one side only would count for little.
Therefore the sum goes over the best grasp of each sampled surface point, weighted by the area that the point stands
for: with a gain of 1 it is the mean score of the best grasps within d_th, where points without any count 0.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import build_grid, cell_range

D_TH = 0.01
"""Distance between a point and the grasps that count for it [m]."""


def grasp_weights(area: Array, points: int, gain: float) -> Array:
    """The weight of a grasp of each of K objects.

    Args:
        area: (K,) surface of the objects [m^2].
        points: how many points were sampled on each.
        gain: factor on the mean score of a place; tanh(gain) is the highest confidence.
    """
    return gain * np.asarray(area, float) / (points * np.pi * D_TH**2)


def point_confidence(points: npt.ArrayLike, entry_points: npt.ArrayLike, weighted_scores: npt.ArrayLike) -> Array:
    """tanh(sum of the weighted scores within D_TH) for points (N, 3) -> (N,) in [0, 1).

    Args:
        points: (N, 3) [m].
        entry_points: (M, 3) of the grasps, in the same frame [m].
        weighted_scores: (M,) score times weight; plain scores give the paper's equation.
    """
    at = np.ascontiguousarray(points, np.float64)
    total = np.zeros(len(at))
    grid = build_grid(np.ascontiguousarray(entry_points, np.float64), D_TH)
    if len(grid.points) and len(at):
        scores = np.ascontiguousarray(np.asarray(weighted_scores, np.float64)[grid.order])

        places = (grid.start, grid.origin, grid.shape, grid.cell)
        for_each_range(_sum, len(at), 800, at, grid.points, scores, *places, total)
    return np.tanh(total)


@compiled
def _sum(begin, end, at, points, scores, starts, origin, shape, cell, total):  # type: ignore[no-untyped-def]
    for n in range(begin, end):
        x, y, z = at[n]
        i0, i1 = cell_range(x - D_TH, x + D_TH, origin[0], cell, shape[0])
        j0, j1 = cell_range(y - D_TH, y + D_TH, origin[1], cell, shape[1])
        k0, k1 = cell_range(z - D_TH, z + D_TH, origin[2], cell, shape[2])
        if k1 < k0:
            continue
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                row = (i * shape[1] + j) * shape[2]
                for p in range(starts[row + k0], starts[row + k1 + 1]):
                    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    if dx * dx + dy * dy + dz * dz < D_TH * D_TH:
                        total[n] += scores[p]
