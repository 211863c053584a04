"""Points sorted by the horizontal cells that they are in: those of cells side by side can be looked at 16 at a time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.ops.compiled import compiled
from regnet_core.ops.lanes import BOXES
from regnet_core.ops.voxel_grid import bounds_loop

_MAX_CELLS = 1_000_000
"""Points spread so wide that they would need more get larger ones."""
_FAR = np.float32(1e18)
"""Nothing is near this, and its square is a number [m]."""


class CellPoints(NamedTuple):
    """N points by the cells that they are in, by x and then y; those of the cells (i, j0..j1) are contiguous."""

    points: npt.NDArray[np.float32]
    """(3, N + 16): their x, their y and their z as seen from ``low``, and far ones at the end [m]."""
    start: npt.NDArray[np.int32]
    """(nx, ny + 1): where the points of each cell begin; those of (i, j) end where those of (i, j + 1) begin."""
    low: npt.NDArray[np.float64]
    """(3,): the lower corner of all points and of cell (0, 0) [m]."""
    cell: float
    """Edge length of a cell [m]."""


def points_in_cells(points: npt.NDArray[Any], cell: float) -> CellPoints:
    """Sort points (N, 3), N > 0, into cells of about this edge length [m]; points of one cell keep their order."""
    return CellPoints(*_sorted(np.ascontiguousarray(points, np.float64), cell, _MAX_CELLS))


@compiled
def _sorted(points, cell, most):  # type: ignore[no-untyped-def]
    low, high = bounds_loop(points)
    while True:
        nx, ny = np.int64((high[0] - low[0]) / cell) + 1, np.int64((high[1] - low[1]) / cell) + 1
        if np.float64(nx) * np.float64(ny) <= most:
            break
        cell *= 1.5
    keys, free = np.empty(len(points), np.int32), np.zeros(nx * ny + 1, np.int32)
    for p in range(len(points)):
        keys[p] = np.int64((points[p, 0] - low[0]) / cell) * ny + np.int64((points[p, 1] - low[1]) / cell)
        free[keys[p] + 1] += 1
    start, before = np.empty((nx, ny + 1), np.int32), 0
    for i in range(nx):
        start[i, 0] = before
        for j in range(ny):
            here = free[i * ny + j + 1]
            free[i * ny + j] = before
            before += here
            start[i, j + 1] = before
    at = np.empty((3, len(points) + BOXES), np.float32)
    at[:, len(points) :] = _FAR
    for p in range(len(points)):
        place = free[keys[p]]
        free[keys[p]] += 1
        for a in range(3):
            at[a, place] = points[p, a] - low[a]
    return at, start, low, cell
