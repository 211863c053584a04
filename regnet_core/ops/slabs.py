"""The points in a slab about a plane: how many they are, and the better plane that follows from them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled, compiled_with_any_order
from regnet_core.ops.parallel import for_each_range

_BLOCKS = 16
"""Sums of so many blocks are added up in the same order on any number of cores."""


class Planes(NamedTuple):
    """normal . x = offset, each."""

    normals: Array
    """(P, 3) of length 1."""
    offsets: Array
    """(P,) [m]."""


def slab_counts(points: Array, normals: Array, offsets: Array, tolerance: float) -> npt.NDArray[np.int64]:
    """How many of the points (N, 3) are nearer than ``tolerance`` [m] to each plane ``normals @ x = offsets``, (P,)."""
    x, y, z = (np.ascontiguousarray(column) for column in points.T)
    counts = np.zeros(len(normals), np.int64)
    for_each_range(_count, len(normals), len(x) / 3, x, y, z, normals, offsets, tolerance, counts)
    return counts


def fitted_plane(points: Array, normal: Array, offset: float, tolerance: float, rounds: int) -> tuple[Array, float]:
    """Least squares on the points (N, 3) nearer than ``tolerance`` [m] to a plane -> a better plane, normal upwards.

    Repeated at most ``rounds`` times, until as many points are near as before, or fewer than 10.
    """
    points, normal = np.ascontiguousarray(points), np.asarray(normal, np.float64)
    sums, before = np.empty((_BLOCKS, 10)), -1.0
    for _ in range(rounds):
        given = (float(normal[0]), float(normal[1]), float(normal[2]), float(offset))
        for_each_range(_sums, _BLOCKS, 1.1 * len(points) / _BLOCKS, points, given, tolerance, sums)
        before, normal, offset = _fitted(sums, normal, offset, before)
        if before < 0.0:
            break
    return normal, float(offset)


def planes_of_triples(a: Array, b: Array, c: Array, least_cosine: float, shortest: float) -> Planes:
    """Planes through triples of points (T, 3), normals upwards; those not steeper than allowed -> P of T.

    Args:
        a: first points [m].
        b: second points [m].
        c: third points [m].
        least_cosine: of the angle between a normal and z.
        shortest: length of the cross product below which three points are in a line [m2].
    """
    normals, offsets = np.empty((len(a), 3)), np.empty(len(a))
    count = _through(a, b, c, least_cosine, shortest, normals, offsets)
    return Planes(normals[:count], offsets[:count])


@compiled
def _count(begin, end, x, y, z, normals, offsets, tolerance, counts):  # type: ignore[no-untyped-def]
    for p in range(begin, end):
        a, b, c, d = normals[p, 0], normals[p, 1], normals[p, 2], offsets[p]
        n = 0
        for i in range(len(x)):
            n += abs(a * x[i] + b * y[i] + c * z[i] - d) < tolerance
        counts[p] = n


@compiled_with_any_order
def _sums(begin, end, points, plane, tolerance, sums):  # type: ignore[no-untyped-def]
    """Of blocks of points: how many are near, and the sums of x, y, z, xx, xy, xz, yy, yz, zz of those.

    They are taken from the plane's point nearest to the origin: what is squared stays small.
    """
    a, b, c, d = plane
    for block in range(begin, end):
        n = 0.0
        sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
        for i in range(len(points) * block // len(sums), len(points) * (block + 1) // len(sums)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            near = 1.0 if abs(a * x + b * y + c * z - d) < tolerance else 0.0
            x, y, z = near * (x - d * a), near * (y - d * b), near * (z - d * c)
            n += near
            sx += x
            sy += y
            sz += z
            sxx += x * x
            sxy += x * y
            sxz += x * z
            syy += y * y
            syz += y * z
            szz += z * z
        sums[block, 0], sums[block, 1], sums[block, 2], sums[block, 3] = n, sx, sy, sz
        sums[block, 4], sums[block, 5], sums[block, 6] = sxx, sxy, sxz
        sums[block, 7], sums[block, 8], sums[block, 9] = syy, syz, szz


@compiled
def _fitted(blocks, normal, offset, before):  # type: ignore[no-untyped-def]
    """How many points are near, and the better plane; -1 where there is none."""
    sums = blocks.sum(axis=0)
    count = sums[0]
    if count < 10.0 or count == before:
        return -1.0, normal, offset
    shift = sums[1:4] / count
    covariance = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            low, high = min(i, j), max(i, j)
            covariance[i, j] = sums[4 + low * (5 - low) // 2 + high] / count - shift[i] * shift[j]
    axis = np.linalg.eigh(covariance)[1][:, 0]
    if axis[2] == 0.0:
        return -1.0, normal, offset
    if axis[2] < 0.0:
        axis = -axis
    near = offset * normal + shift
    better = axis.copy()
    return count, better, better[0] * near[0] + better[1] * near[1] + better[2] * near[2]


@compiled
def _through(a, b, c, least_cosine, shortest, normals, offsets):  # type: ignore[no-untyped-def]
    count = 0
    for t in range(len(a)):
        x0, y0, z0 = b[t, 0] - a[t, 0], b[t, 1] - a[t, 1], b[t, 2] - a[t, 2]
        x1, y1, z1 = c[t, 0] - a[t, 0], c[t, 1] - a[t, 1], c[t, 2] - a[t, 2]
        x, y, z = y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1
        length = np.sqrt(x * x + y * y + z * z)
        if not (length > shortest and abs(z) > least_cosine * length):
            continue
        length = length if z > 0.0 else -length
        normals[count, 0], normals[count, 1], normals[count, 2] = x / length, y / length, z / length
        offsets[count] = (x * a[t, 0] + y * a[t, 1] + z * a[t, 2]) / length
        count += 1
    return count
