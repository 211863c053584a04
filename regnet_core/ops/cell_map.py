"""A map of the cells of a horizontal grid that points are in, and which of the cells hang together."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import bounds_loop

LARGEST = 4_000_000
"""Cells of the largest map that is made."""


class CellMap(NamedTuple):
    """The cells floor(x / cell), floor(y / cell) of N points, on a map of those in their bounding rectangle."""

    place: npt.NDArray[np.int32]
    """(N,): the number of each point's cell."""
    number: npt.NDArray[np.int32]
    """(C,): how many points there are in each cell."""
    first: npt.NDArray[np.int64]
    """(2,): the cell with the number 0."""
    across: int
    """Cells with the same x; numbers rise with y, then with x."""
    cell: float
    """Edge length [m]."""

    @classmethod
    def of(cls, points: npt.NDArray[Any], cell: float) -> CellMap | None:
        """Of points (N, >= 2), N > 0 [m]; None where it would be too large."""
        place, number, first, across = _map(np.ascontiguousarray(points), points.dtype.type(1.0 / cell), LARGEST)
        return cls(place, number, first, across, cell) if across > 0 else None

    def groups(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int64]]:
        """Cells with points that touch, at a side or a corner, belong together.

        Returns:
            The group (C,) of each cell, -1 for those without points; groups are numbered by their first cell. And how
            many points each group has.
        """
        group = np.full(len(self.number), -1, np.int32)
        sizes = np.zeros(np.count_nonzero(self.number), np.int64)
        found = _spread(self.number, self.across, group, np.empty(len(sizes), np.int32), sizes)
        return group, sizes[:found]

    def of_points(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(N,): values (C,) of cells, for the points in them."""
        found = np.empty(len(self.place), values.dtype)
        for_each_range(_gather, len(self.place), 1, self.place, values, found)
        return found


@compiled
def _map(points, per_metre, largest):  # type: ignore[no-untyped-def]
    lower, upper = bounds_loop(points)
    i0, j0 = np.int64(np.floor(lower[0] * per_metre)), np.int64(np.floor(lower[1] * per_metre))
    rows = np.int64(np.floor(upper[0] * per_metre)) - i0 + 1
    across = np.int64(np.floor(upper[1] * per_metre)) - j0 + 1
    if np.float64(rows) * np.float64(across) > largest:
        return np.empty(0, np.int32), np.empty(0, np.int32), np.array([i0, j0]), 0
    place, number = np.empty(len(points), np.int32), np.zeros(rows * across, np.int32)
    for p in range(len(points)):
        i, j = np.int64(np.floor(points[p, 0] * per_metre)), np.int64(np.floor(points[p, 1] * per_metre))
        place[p] = (i - i0) * across + j - j0
    for p in range(len(points)):
        number[place[p]] += 1
    return place, number, np.array([i0, j0]), across


@compiled
def _spread(count, across, group, waiting, sizes):  # type: ignore[no-untyped-def]
    """From each first cell to all that can be reached."""
    found, rows = 0, len(count) // across
    for c in range(len(count)):
        if count[c] == 0 or group[c] >= 0:
            continue
        group[c], waiting[0], n = found, c, 1
        while n > 0:
            n -= 1
            at = waiting[n]
            sizes[found] += count[at]
            i, j = at // across, at % across
            for row in range(max(i - 1, 0), min(i + 2, rows)):
                for column in range(max(j - 1, 0), min(j + 2, across)):
                    other = row * across + column
                    if count[other] > 0 and group[other] < 0:
                        group[other], waiting[n] = found, other
                        n += 1
        found += 1
    return found


@compiled
def _gather(begin, end, place, values, found):  # type: ignore[no-untyped-def]
    for p in range(begin, end):
        found[p] = values[place[p]]
