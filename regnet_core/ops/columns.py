"""Volumes that are filled up to a height map, on a grid of voxels: their smoothed occupancy, and its surface."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled, inlined
from regnet_core.ops.parallel import for_each_range


def smoothed_columns(
    top: npt.NDArray[np.floating], z: npt.NDArray[np.floating], deviation: float, truncate: float
) -> Array:
    """(nx, ny, nz) in [0, 1]: the columns, smoothed by a Gaussian.

    As ``scipy.ndimage.gaussian_filter`` does it, up to rounding, where nothing is filled within the Gaussian's reach of
    the grid's sides. A column is a step, so that along z there are only as many different results as levels.

    Args:
        top: (nx, ny), up to where each column is filled; 0 or less: not at all [m].
        z: (nz,) of the voxels' centres, rising [m].
        deviation: of the Gaussian [voxels].
        truncate: where it ends [deviations].
    """
    filled = np.where(top > 0.0, np.searchsorted(z, top), 0)
    steps = np.tri(len(z) + 1, len(z), -1, dtype=np.float32)
    table = ndimage.gaussian_filter1d(steps, deviation, axis=1, truncate=truncate)
    reach = int(truncate * deviation + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    weights = (weights / weights.sum()).astype(np.float32)
    across = np.empty((*top.shape, len(z)), np.float32)
    density = np.empty_like(across)
    some = np.zeros(top.shape, np.bool_)
    for_each_range(lambda start, stop: _along_y(filled, table, weights, start, stop, across, some), len(top), least=4)
    for_each_range(lambda start, stop: _along_x(across, some, weights, start, stop, density), len(top), least=4)
    return density


def surface_voxels(density: npt.NDArray[np.floating], level: float, first: int) -> npt.NDArray[np.int64]:
    """(V, 3), rising: the voxels above the level that touch one that is not, or the end of the grid, at a face.

    Args:
        density: (nx, ny, nz).
        level: what the surface lies at.
        first: voxels below this index along z are left out.
    """
    counts = np.zeros(len(density) + 1, np.int64)
    for_each_range(lambda a, b: _count_surface(density, level, first, a, b, counts), len(density), least=4)
    start = np.cumsum(counts)
    found = np.empty((start[-1], 3), np.int64)
    for_each_range(lambda a, b: _list_surface(density, level, first, start, a, b, found), len(density), least=4)
    return found


@compiled
def _along_y(filled, table, weights, begin, end, across, some):  # type: ignore[no-untyped-def]
    reach, ny = len(weights) // 2, filled.shape[1]
    for x in range(begin, end):
        for y in range(ny):
            row = across[x, y]
            row[:] = 0.0
            for k in range(-reach, reach + 1):
                level = filled[x, min(max(y + k, 0), ny - 1)]
                if level > 0:
                    some[x, y] = True
                    weight, column = weights[k + reach], table[level]
                    for z in range(len(row)):
                        row[z] += weight * column[z]


@compiled
def _along_x(across, some, weights, begin, end, density):  # type: ignore[no-untyped-def]
    reach, nx = len(weights) // 2, len(across)
    for x in range(begin, end):
        for y in range(across.shape[1]):
            row = density[x, y]
            row[:] = 0.0
            for k in range(-reach, reach + 1):
                other = min(max(x + k, 0), nx - 1)
                if some[other, y]:
                    weight, column = weights[k + reach], across[other, y]
                    for z in range(len(row)):
                        row[z] += weight * column[z]


@inlined
def _surface_of_row(density, level, x, y, flags):  # type: ignore[no-untyped-def]
    """Whether each voxel (nz,) of a column is one of the surface; false for all where the column does not reach it."""
    nx, ny, nz = density.shape
    row, outer = density[x, y], x == 0 or y == 0 or x == nx - 1 or y == ny - 1
    left, right = density[max(x - 1, 0), y], density[min(x + 1, nx - 1), y]
    near, far = density[x, max(y - 1, 0)], density[x, min(y + 1, ny - 1)]
    for z in range(nz):
        # Arithmetic on truth values has no branches.
        sides = (left[z] > level) & (right[z] > level) & (near[z] > level) & (far[z] > level)
        flags[z] = (row[z] > level) & ((not sides) | outer)
    for z in range(nz):
        ends = z == 0 or z == nz - 1
        if row[z] > level and (ends or not (row[z - 1] > level and row[z + 1] > level)):
            flags[z] = True


@compiled
def _count_surface(density, level, first, begin, end, counts):  # type: ignore[no-untyped-def]
    flags = np.empty(density.shape[2], np.bool_)
    for x in range(begin, end):
        n = 0
        for y in range(density.shape[1]):
            _surface_of_row(density, level, x, y, flags)
            for z in range(first, len(flags)):
                n += flags[z]
        counts[x + 1] = n


@compiled
def _list_surface(density, level, first, start, begin, end, found):  # type: ignore[no-untyped-def]
    flags = np.empty(density.shape[2], np.bool_)
    for x in range(begin, end):
        n = start[x]
        for y in range(density.shape[1]):
            if n == start[x + 1]:
                break
            _surface_of_row(density, level, x, y, flags)
            for z in range(first, len(flags)):
                if flags[z]:
                    found[n, 0], found[n, 1], found[n, 2] = x, y, z
                    n += 1
