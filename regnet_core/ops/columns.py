"""Volumes that are filled up to a height map, on a grid of voxels: their smoothed occupancy, and its surface."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range


class Walls(NamedTuple):
    """Points on a surface."""

    points: Array
    """(W, 3) [voxels]."""
    normals: Array
    """(W, 3), of length 1, to where the density is lower."""


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
    table, weights = _kernels(len(z), deviation, truncate)
    filled = np.empty(top.shape, np.int32)
    _levels(top, z, filled)
    across = np.empty((*top.shape, len(z)), np.float32)
    density = np.empty_like(across)
    some, voxels = np.zeros(top.shape, np.bool_), top.shape[1] * len(z)
    for_each_range(_along_y, len(top), 0.8 * voxels, filled, table, weights, across, some)
    for_each_range(_along_x, len(top), 1.2 * voxels, across, some, weights, density)
    return density


@lru_cache(maxsize=64)
def _kernels(levels: int, deviation: float, truncate: float) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """A step up to each of the levels, smoothed (levels + 1, levels), and the Gaussian."""
    steps = np.tri(levels + 1, levels, -1, dtype=np.float32)
    table = ndimage.gaussian_filter1d(steps, deviation, axis=1, truncate=truncate)
    reach = int(truncate * deviation + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    weights = (weights / weights.sum()).astype(np.float32)
    table.flags.writeable = weights.flags.writeable = False
    return table, weights


def surface_voxels(density: npt.NDArray[np.floating], level: float, first: int) -> npt.NDArray[np.int64]:
    """(V, 3), rising: the voxels above the level that touch one that is not, or the end of the grid, at a face.

    Args:
        density: (nx, ny, nz).
        level: what the surface lies at.
        first: voxels below this index along z are left out.
    """
    nx, ny, nz = density.shape
    solid, counts = np.zeros((nx + 2, ny + 2, nz + 2), np.uint8), np.zeros(nx + 1, np.int64)
    surface = np.empty((nx, ny, nz), np.uint8)
    for_each_range(_mark_solid, nx, 0.5 * ny * nz, density, level, solid)
    for_each_range(_mark_surface, nx, 1.0 * ny * nz, solid, first, surface, counts)
    start = np.cumsum(counts)
    found = np.empty((start[-1], 3), np.int64)
    for_each_range(_list_marked, nx, 0.3 * ny * nz, surface, start, found)
    return found


def turned_down(
    normals: Array,
    density: npt.NDArray[np.floating],
    origin: Array,
    cell: float,
    points: Array,
    height: Array,
    step: float,
) -> Array:
    """Normals (N, 3), made to have length 1 and turned to where the density falls.

    Args:
        normals: not 0.
        density: (nx, ny, nz), interpolated between linearly; outside, it is what it is at the side.
        origin: (3,), the centre of voxel (0, 0, 0): x, y, height [m].
        cell: edge length of a voxel [m].
        points: (N, 3), of which x and y count [m].
        height: (N,) of these points [m].
        step: it is asked what the density rises by from so far before to so far behind, along each axis [voxels].
    """
    turned = np.empty((len(points), 3))
    for_each_range(_turn, len(points), 130, normals, density, origin, cell, points, height, step, turned)
    return turned


def walls(density: npt.NDArray[np.floating], index: npt.NDArray[np.int64], level: float, least: float) -> Walls:
    """Where the surface that the density crosses the level at is, near voxels (V, 3), and which way it faces.

    Args:
        density: (nx, ny, nz).
        index: (V, 3), of voxels.
        level: of the surface.
        least: voxels at which the density falls by less than this from one to the next are left out.
    """
    points, normals = np.empty((len(index), 3)), np.empty((len(index), 3))
    kept = _walls(density, index, level, least, points, normals)
    return Walls(points[:kept], normals[:kept])


@compiled
def _value_at(density, x, y, z):  # type: ignore[no-untyped-def]
    """Linear between the centres of the voxels."""
    nx, ny, nz = density.shape
    x, y, z = min(max(x, 0.0), nx - 1.0), min(max(y, 0.0), ny - 1.0), min(max(z, 0.0), nz - 1.0)
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - i, y - j, z - k
    i1, j1, k1 = min(i + 1, nx - 1), min(j + 1, ny - 1), min(k + 1, nz - 1)
    near = (density[i, j, k] * (1 - w) + density[i, j, k1] * w) * (1 - v) + (
        density[i, j1, k] * (1 - w) + density[i, j1, k1] * w
    ) * v
    far = (density[i1, j, k] * (1 - w) + density[i1, j, k1] * w) * (1 - v) + (
        density[i1, j1, k] * (1 - w) + density[i1, j1, k1] * w
    ) * v
    return near * (1 - u) + far * u


@compiled
def _turn(begin, end, normals, density, origin, cell, points, height, step, turned):  # type: ignore[no-untyped-def]
    for p in range(begin, end):
        x, y = (points[p, 0] - origin[0]) / cell, (points[p, 1] - origin[1]) / cell
        z = (height[p] - origin[2]) / cell
        a, b, c = normals[p, 0], normals[p, 1], normals[p, 2]
        rise = a * (_value_at(density, x + step, y, z) - _value_at(density, x - step, y, z))
        rise += b * (_value_at(density, x, y + step, z) - _value_at(density, x, y - step, z))
        rise += c * (_value_at(density, x, y, z + step) - _value_at(density, x, y, z - step))
        length = np.sqrt(a * a + b * b + c * c)
        length = -length if rise > 0.0 else length
        turned[p, 0], turned[p, 1], turned[p, 2] = a / length, b / length, c / length


@compiled
def _levels(top, z, filled):  # type: ignore[no-untyped-def]
    """How many levels lie below the top of each column, which is filled above 0."""
    step = z[1] - z[0] if len(z) > 1 else 1.0
    for i in range(top.shape[0]):
        for j in range(top.shape[1]):
            level, height = 0, top[i, j]
            if height > 0.0:
                level = min(max(int((height - z[0]) / step), 0), len(z))
                while level < len(z) and z[level] < height:
                    level += 1
                while level > 0 and z[level - 1] >= height:
                    level -= 1
            filled[i, j] = level


@compiled
def _walls(density, index, level, least, points, normals):  # type: ignore[no-untyped-def]
    nx, ny, nz = density.shape
    n = 0
    for v in range(len(index)):
        x, y, z = index[v, 0], index[v, 1], index[v, 2]
        # Half the difference of the two neighbours; on the border, of those next to it.
        i, j, k = min(max(x, 1), nx - 2), min(max(y, 1), ny - 2), min(max(z, 1), nz - 2)
        gx = 0.5 * np.float64(density[i + 1, j, k] - density[i - 1, j, k])
        gy = 0.5 * np.float64(density[i, j + 1, k] - density[i, j - 1, k])
        gz = 0.5 * np.float64(density[i, j, k + 1] - density[i, j, k - 1])
        slope = np.sqrt(gx * gx + gy * gy + gz * gz)
        if not slope > least:
            continue
        normals[n, 0], normals[n, 1], normals[n, 2] = -gx / slope, -gy / slope, -gz / slope
        # To first order the surface lies where the density has fallen to the level.
        out = min(max((np.float64(density[x, y, z]) - level) / slope, 0.0), 1.0)
        points[n, 0], points[n, 1], points[n, 2] = x, y, z
        for a in range(3):
            points[n, a] += normals[n, a] * out
        n += 1
    return n


@compiled
def _along_y(begin, end, filled, table, weights, across, some):  # type: ignore[no-untyped-def]
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
def _along_x(begin, end, across, some, weights, density):  # type: ignore[no-untyped-def]
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


@compiled
def _mark_solid(begin, end, density, level, solid):  # type: ignore[no-untyped-def]
    """Which voxels are above the level, with a border of those that are not."""
    for x in range(begin, end):
        for y in range(density.shape[1]):
            row, marked = density[x, y], solid[x + 1, y + 1, 1:-1]
            for z in range(len(row)):
                marked[z] = row[z] > level


@compiled
def _mark_surface(begin, end, solid, first, surface, counts):  # type: ignore[no-untyped-def]
    """In bytes, of which a register holds many."""
    for x in range(begin, end):
        n = 0
        for y in range(surface.shape[1]):
            row, marked = solid[x + 1, y + 1], surface[x, y]
            left, right, near, far = solid[x, y + 1], solid[x + 2, y + 1], solid[x + 1, y], solid[x + 1, y + 2]
            for z in range(len(marked)):
                inside = left[z + 1] & right[z + 1] & near[z + 1] & far[z + 1] & row[z] & row[z + 2]
                marked[z] = row[z + 1] & (inside ^ np.uint8(1))
            marked[:first] = 0
            own = 0
            for z in range(len(marked)):
                own += marked[z]
            n += own
        counts[x + 1] = n


@compiled
def _list_marked(begin, end, surface, start, found):  # type: ignore[no-untyped-def]
    for x in range(begin, end):
        n = start[x]
        for y in range(surface.shape[1]):
            if n == start[x + 1]:
                break
            marked = surface[x, y]
            some = np.uint8(0)
            for z in range(len(marked)):
                some |= marked[z]
            if some:
                for z in range(len(marked)):
                    if marked[z]:
                        found[n, 0], found[n, 1], found[n, 2] = x, y, z
                        n += 1
