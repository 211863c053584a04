"""Volumes that are filled up to a height map, on a grid of voxels: their smoothed occupancy, and its surface."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from regnet_core.geometry import Array, Mask
from regnet_core.ops.compiled import compiled, inlined
from regnet_core.ops.lanes import weighted_sum
from regnet_core.ops.parallel import for_each_range

TOGETHER = 16
"""Levels that are computed at a time; grids have a multiple of these."""
_HALF = 0.5
"""A voxel that is filled by more than this is inside."""


class Volume(NamedTuple):
    """How far each voxel is filled, for the columns that are near filled ones; most of a map is empty."""

    row: npt.NDArray[np.int32]
    """(nx, ny): which row each column has; 0 for those with nothing near."""
    filled: npt.NDArray[np.float32]
    """(R, nz) in [0, 1], never rising along z; 0 in the first row. ``filled[row]`` is the whole volume."""
    inside: npt.NDArray[np.int64]
    """(R,): how many voxels of each row, the lowest ones, are filled by more than a half."""


class Walls(NamedTuple):
    """Points on a surface."""

    points: Array
    """(W, 3) [m]."""
    normals: Array
    """(W, 3), of length 1, to where less is filled."""
    clear: Mask
    """(W,): whether the filling falls so fast that this means much."""


def smoothed_columns(
    top: npt.NDArray[np.floating], z: npt.NDArray[np.floating], deviation: float, truncate: float
) -> Volume:
    """Columns that are filled from below, smoothed by a Gaussian.

    As ``scipy.ndimage.gaussian_filter`` does it, up to rounding, where nothing is filled within the Gaussian's reach of
    the grid's sides. A column is a step, so that along z there are only as many different results as levels.

    Args:
        top: (nx, ny), up to where each column is filled; 0 or less: not at all [m].
        z: (nz,) of the voxels' centres, rising [m]; a multiple of ``TOGETHER``.
        deviation: of the Gaussian [voxels].
        truncate: where it ends [deviations].
    """
    if len(z) % TOGETHER != 0:
        raise ValueError(f"the number of levels must be a multiple of {TOGETHER}, got {len(z)}")
    table, weights = _kernels(len(z), deviation, truncate)
    levels, reached, row, rows = _rows(top, z, len(weights) // 2)
    across, filled = np.empty((rows, len(z)), np.float32), np.empty((rows, len(z)), np.float32)
    inside, voxels = np.empty(rows, np.int64), top.shape[1] * len(z)
    filled[0], inside[0] = 0.0, 0
    for_each_range(_along_y, len(top), 0.4 * voxels, levels, table, weights, reached, row, across)
    for_each_range(_along_x, len(top), 0.6 * voxels, across, reached, row, weights, filled, inside)
    return Volume(row, filled, inside)


@lru_cache(maxsize=8)
def _kernels(levels: int, deviation: float, truncate: float) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """A step up to each of the levels, smoothed (levels + 1, levels), and the Gaussian."""
    steps = np.tri(levels + 1, levels, -1, dtype=np.float32)
    table = ndimage.gaussian_filter1d(steps, deviation, axis=1, truncate=truncate)
    reach = int(truncate * deviation + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    weights = (weights / weights.sum()).astype(np.float32)
    table.flags.writeable = weights.flags.writeable = False
    return table, weights


def turned_down(
    normals: Array,
    volume: Volume,
    origin: Array,
    cell: float,
    points: Array,
    height: Array,
    step: float,
) -> Array:
    """Normals (N, 3), made to have length 1 and turned to where less is filled.

    Args:
        normals: not 0.
        volume: interpolated between linearly; outside, it is what it is at the side.
        origin: (3,), the centre of voxel (0, 0, 0): x, y, height [m].
        cell: edge length of a voxel [m].
        points: (N, 3), of which x and y count [m].
        height: (N,) of these points [m].
        step: it is asked how much more is filled from so far before to so far behind, along each axis [voxels].
    """
    turned = np.empty((len(points), 3))
    for_each_range(
        _turn, len(points), 130, normals, volume.row, volume.filled, origin, cell, points, height, step, turned
    )
    return turned


def walls(volume: Volume, first: int, least: float, origin: Array, cell: float, normal: Array, offset: float) -> Walls:
    """The volume's surface, where voxels are half filled: one point for each voxel inside that touches, at a face, one
    that is not or the end of the grid; columns go on below it.

    Args:
        volume: of nx, ny and nz voxels.
        first: voxels below this index along z are left out.
        least: surfaces are clear where the filling falls by more than this from one voxel to the next.
        origin: (3,), the centre of voxel (0, 0, 0): x, y, height above a plane [m].
        cell: edge length of a voxel [m].
        normal: (3,) of the plane, the third number positive.
        offset: of the plane [m].
    """
    start = _starts(volume.row, volume.inside, first)
    count = int(start[-1])
    found = Walls(np.empty((count, 3)), np.empty((count, 3)), np.empty(count, np.bool_))
    for_each_range(
        _walls, len(start) - 1, 35 * count / len(start), *volume, first, least, origin, cell, normal, offset, start,
        *found,
    )  # fmt: skip
    return found


@compiled
def _rows(top, z, reach):  # type: ignore[no-untyped-def]
    """Of each column: up to which level it is filled, whether there is a filled one within reach along y, and which row
    it has; and how many rows there are."""
    nx, ny = top.shape
    levels, reached = np.zeros((nx, ny), np.int32), np.zeros((nx, ny), np.uint8)
    row = np.zeros((nx, ny), np.int32)
    step = z[1] - z[0] if len(z) > 1 else 1.0
    some = np.zeros(ny, np.uint8)
    for i in range(nx):
        own = levels[i]
        for j in range(ny):
            height = top[i, j]
            if height > 0.0:
                level = min(max(int((height - z[0]) / step), 0), len(z))
                while level < len(z) and z[level] < height:
                    level += 1
                while level > 0 and z[level - 1] >= height:
                    level -= 1
                own[j] = level
            some[j] = own[j] > 0
        near = reached[i]
        for k in range(-reach, reach + 1):
            others = some[max(k, 0) : max(min(ny + k, ny), 0)]
            at = near[max(-k, 0) : max(min(ny - k, ny), 0)]
            for j in range(len(at)):
                at[j] |= others[j]
    count = 1
    for i in range(nx):
        some[:] = 0
        for k in range(max(i - reach, 0), min(i + reach + 1, nx)):
            for j in range(ny):
                some[j] |= reached[k, j]
        for j in range(ny):
            row[i, j] = count if some[j] else 0
            count += some[j]
    return levels, reached, row, count


@compiled
def _along_y(begin, end, levels, table, weights, reached, row, across):  # type: ignore[no-untyped-def]
    reach, ny, each = len(weights) // 2, levels.shape[1], 4 * across.shape[1]
    places, shares = np.empty(len(weights), np.int64), np.empty(len(weights), np.float32)
    sums, given, listed, scales = across.ctypes.data, table.ctypes.data, places.ctypes.data, shares.ctypes.data
    for x in range(begin, end):
        for y in range(ny):
            if not reached[x, y]:
                continue
            n = 0
            for k in range(-reach, reach + 1):
                level = levels[x, min(max(y + k, 0), ny - 1)]
                if level > 0:
                    places[n], shares[n] = given + level * each, weights[k + reach]
                    n += 1
            for z in range(0, each, 4 * TOGETHER):
                weighted_sum(sums + row[x, y] * each + z, listed, z, scales, n)


@compiled
def _along_x(begin, end, across, reached, row, weights, filled, inside):  # type: ignore[no-untyped-def]
    reach, nx, nz = len(weights) // 2, len(row), filled.shape[1]
    each, n = 4 * nz, 0
    places, shares = np.empty(len(weights), np.int64), np.empty(len(weights), np.float32)
    sums, given, listed, scales = filled.ctypes.data, across.ctypes.data, places.ctypes.data, shares.ctypes.data
    for x in range(begin, end):
        for y in range(row.shape[1]):
            own = row[x, y]
            if own == 0:
                continue
            m = 0
            for k in range(-reach, reach + 1):
                other = min(max(x + k, 0), nx - 1)
                if reached[other, y]:
                    places[m], shares[m] = given + row[other, y] * each, weights[k + reach]
                    m += 1
            for z in range(0, each, 4 * TOGETHER):
                weighted_sum(sums + own * each + z, listed, z, scales, m)
            # All that is summed up falls along z, and rounding keeps that.
            while n > 0 and filled[own, n - 1] <= _HALF:
                n -= 1
            while n < nz and filled[own, n] > _HALF:
                n += 1
            inside[own] = n


@inlined
def _lowest_wall(row, inside, x, y, first):  # type: ignore[no-untyped-def]
    """The column's first voxel at the surface; the others are those above it that are inside."""
    nx, ny = row.shape
    lowest = inside[row[x, y]] - 1
    lowest = min(lowest, inside[row[x - 1, y]] if x > 0 else 0)
    lowest = min(lowest, inside[row[x + 1, y]] if x + 1 < nx else 0)
    lowest = min(lowest, inside[row[x, y - 1]] if y > 0 else 0)
    lowest = min(lowest, inside[row[x, y + 1]] if y + 1 < ny else 0)
    return max(lowest, first)


@compiled
def _starts(row, inside, first):  # type: ignore[no-untyped-def]
    """Of each x: how many voxels at the surface come before -> (nx + 1,)."""
    start = np.zeros(len(row) + 1, np.int64)
    for x in range(len(row)):
        n = 0
        for y in range(row.shape[1]):
            if row[x, y] > 0:
                n += max(inside[row[x, y]] - _lowest_wall(row, inside, x, y, first), 0)
        start[x + 1] = start[x] + n
    return start


@compiled
def _walls(begin, end, row, filled, inside, first, least, origin, cell, normal, offset, start, points, normals, clear):  # type: ignore[no-untyped-def]
    (nx, ny), nz = row.shape, filled.shape[1]
    for x in range(begin, end):
        n = start[x]
        for y in range(ny):
            if row[x, y] == 0:
                continue
            # Half the difference of the two neighbours; on the border, of those next to it.
            i, j = min(max(x, 1), nx - 2), min(max(y, 1), ny - 2)
            left, right, near, far = row[i - 1, j], row[i + 1, j], row[i, j - 1], row[i, j + 1]
            middle, own = row[i, j], row[x, y]
            for z in range(_lowest_wall(row, inside, x, y, first), inside[own]):
                k = min(max(z, 1), nz - 2)
                gx = 0.5 * np.float64(filled[right, k] - filled[left, k])
                gy = 0.5 * np.float64(filled[far, k] - filled[near, k])
                gz = 0.5 * np.float64(filled[middle, k + 1] - filled[middle, k - 1])
                slope = np.sqrt(gx * gx + gy * gy + gz * gz)
                clear[n] = slope > least
                a, b, c = -gx / slope, -gy / slope, -gz / slope
                # To first order the surface lies where the filling has fallen to a half.
                out = min(max((np.float64(filled[own, z]) - _HALF) / slope, 0.0), 1.0)
                px, py = origin[0] + (x + a * out) * cell, origin[1] + (y + b * out) * cell
                height = origin[2] + (z + c * out) * cell
                normals[n, 0], normals[n, 1], normals[n, 2] = a, b, c
                points[n, 0], points[n, 1] = px, py
                points[n, 2] = (offset + height - normal[0] * px - normal[1] * py) / normal[2]
                n += 1


@compiled
def _value_at(row, filled, x, y, z):  # type: ignore[no-untyped-def]
    """Linear between the centres of the voxels."""
    (nx, ny), nz = row.shape, filled.shape[1]
    x, y, z = min(max(x, 0.0), nx - 1.0), min(max(y, 0.0), ny - 1.0), min(max(z, 0.0), nz - 1.0)
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - i, y - j, z - k
    i1, j1, k1 = min(i + 1, nx - 1), min(j + 1, ny - 1), min(k + 1, nz - 1)
    a, b, c, d = row[i, j], row[i, j1], row[i1, j], row[i1, j1]
    near = (filled[a, k] * (1 - w) + filled[a, k1] * w) * (1 - v) + (filled[b, k] * (1 - w) + filled[b, k1] * w) * v
    far = (filled[c, k] * (1 - w) + filled[c, k1] * w) * (1 - v) + (filled[d, k] * (1 - w) + filled[d, k1] * w) * v
    return near * (1 - u) + far * u


@compiled
def _turn(begin, end, normals, row, filled, origin, cell, points, height, step, turned):  # type: ignore[no-untyped-def]
    for p in range(begin, end):
        x, y = (points[p, 0] - origin[0]) / cell, (points[p, 1] - origin[1]) / cell
        z = (height[p] - origin[2]) / cell
        a, b, c = normals[p, 0], normals[p, 1], normals[p, 2]
        rise = a * (_value_at(row, filled, x + step, y, z) - _value_at(row, filled, x - step, y, z))
        rise += b * (_value_at(row, filled, x, y + step, z) - _value_at(row, filled, x, y - step, z))
        rise += c * (_value_at(row, filled, x, y, z + step) - _value_at(row, filled, x, y, z - step))
        length = np.sqrt(a * a + b * b + c * c)
        length = -length if rise > 0.0 else length
        turned[p, 0], turned[p, 1], turned[p, 2] = a / length, b / length, c / length
