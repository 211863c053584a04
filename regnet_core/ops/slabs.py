"""The points in a slab about a plane: how many they are, and the moments that a better plane follows from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled, compiled_with_any_order
from regnet_core.ops.parallel import for_each_range


class SlabMoments(NamedTuple):
    """Of the points in one slab."""

    points: int
    """How many there are."""
    mean: Array
    """(3,) [m]; meaningless without points."""
    covariance: Array
    """(3, 3) [m2], divided by their number."""


def slab_counts(points: Array, normals: Array, offsets: Array, tolerance: float) -> npt.NDArray[np.int64]:
    """How many of the points (N, 3) are nearer than ``tolerance`` [m] to each plane ``normals @ x = offsets``, (P,)."""
    x, y, z = (np.ascontiguousarray(column) for column in points.T)
    counts = np.zeros(len(normals), np.int64)
    for_each_range(
        lambda start, stop: _count(x, y, z, normals, offsets, tolerance, start, stop, counts),
        len(normals),
        each=len(x) / 3,
    )
    return counts


def slab_moments(points: Array, normal: Array, offset: float, tolerance: float) -> SlabMoments:
    """Moments of the points (N, 3) nearer than ``tolerance`` [m] to the plane ``normal @ x = offset``."""
    sums = _sums(points, normal[0], normal[1], normal[2], offset, tolerance)
    scaled = sums / max(sums[0], 1.0)
    near = offset * normal  # sums are taken from here: what is squared stays small
    shift, (xx, xy, xz, yy, yz, zz) = scaled[1:4], scaled[4:]
    square = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return SlabMoments(int(sums[0]), near + shift, square - np.outer(shift, shift))


@compiled
def _count(x, y, z, normals, offsets, tolerance, begin, end, counts):  # type: ignore[no-untyped-def]
    for p in range(begin, end):
        a, b, c, d = normals[p, 0], normals[p, 1], normals[p, 2], offsets[p]
        n = 0
        for i in range(len(x)):
            n += abs(a * x[i] + b * y[i] + c * z[i] - d) < tolerance
        counts[p] = n


@compiled_with_any_order
def _sums(points, a, b, c, d, tolerance):  # type: ignore[no-untyped-def]
    n = 0.0
    sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    for i in range(len(points)):
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
    return np.array([n, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz])
