"""The moments of each point's neighbourhood, and what follows from them: normals, denoised positions and shapes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.buckets import SIZE, Buckets, CornerBuckets, near_bucket
from regnet_core.ops.compiled import compiled, compiled_with_any_order, inlined
from regnet_core.ops.parallel import for_each_range

_SWEEPS = 4
"""Of Jacobi's rotations: afterwards float32 has no digit left that would change."""
_FAR = np.float32(1e6)
"""Nothing is so far away [m]."""
_TINY = np.float32(1e-30)
"""What is divided by is at least this."""
_TRACE, _LEAST_TURN = np.float32(1e8), np.float32(1e-12)
"""Of tensors that are turned, and by what: numbers too small for float32's exponent take a hundred times as long."""


class LocalPlanes(NamedTuple):
    """For each of N points."""

    mean: Array
    """(N, 3): centroid of the neighbours [m]."""
    normal: Array
    """(N, 3): direction of least variance, of arbitrary sign."""
    neighbours: npt.NDArray[np.int64]
    """(N,): number of neighbours, the point itself included."""


def local_planes(points: CornerBuckets, radius: float) -> LocalPlanes:
    """Fit a plane to the points within ``radius`` of each of N points [m]."""
    buckets, corner = points
    count = buckets.number
    made = LocalPlanes(np.empty((count, 3)), np.empty((count, 3)), np.empty(count, np.int64))
    for_each_range(_planes, len(buckets.rows), 8500, buckets, corner, np.float32(radius), *made)
    return made


def flattened(points: Array, planes: LocalPlanes, rows: npt.NDArray[np.int64]) -> Array:
    """(K, 3): points at ``rows`` (K,) of (N, 3), moved along their normals onto the planes of their neighbours [m]."""
    moved = np.empty((len(rows), 3))
    _flatten(points, planes.mean, planes.normal, rows, moved)
    return moved


def relative_covariances(buckets: Buckets, radius: float, least: float) -> npt.NDArray[np.float32]:
    """(N, 3, 3) float32: 3 C / trace(C) - 1, with C the covariance of the points within ``radius`` of each of N [m].

    Args:
        buckets: the points.
        radius: [m].
        least: where the trace is less, the result is 0 [m2].
    """
    made = np.empty((buckets.number, 3, 3), np.float32)
    for_each_range(_relative, len(buckets.rows), 6000, buckets, np.float32(radius), np.float32(least), made)
    return made


@compiled
def _flatten(points, mean, normal, rows, moved):  # type: ignore[no-untyped-def]
    for i in range(len(rows)):
        p, n, m, q = points[rows[i]], normal[rows[i]], mean[rows[i]], moved[i]
        away = (p[0] - m[0]) * n[0] + (p[1] - m[1]) * n[1] + (p[2] - m[2]) * n[2]
        q[0], q[1], q[2] = p[0] - away * n[0], p[1] - away * n[1], p[2] - away * n[2]


@compiled
def _planes(begin, end, buckets, origin, radius, mean, normal, neighbours):  # type: ignore[no-untyped-def]
    found, places, at = _room(buckets)
    sums = np.empty((19, SIZE), np.float32)
    axes = sums[10:]
    for b in range(begin, end):
        _moments(buckets, b, radius, found, places, at, sums)
        _turn_to_axes(sums[4:])
        for i in range(min(SIZE, buckets.number - b * SIZE)):
            row = buckets.rows[b, i]
            neighbours[row] = int(sums[0, i])
            least = 0 if sums[4, i] <= sums[5, i] else 1
            least = least if sums[4 + least, i] <= sums[6, i] else 2
            x, y, z = np.float64(axes[least, i]), np.float64(axes[3 + least, i]), np.float64(axes[6 + least, i])
            length = np.sqrt(x * x + y * y + z * z)
            normal[row, 0], normal[row, 1], normal[row, 2] = x / length, y / length, z / length
            for a in range(3):
                mean[row, a] = origin[a] + buckets.points[b, a, i] + sums[1 + a, i]


@compiled
def _relative(begin, end, buckets, radius, least, made):  # type: ignore[no-untyped-def]
    found, places, at = _room(buckets)
    sums = np.empty((10, SIZE), np.float32)
    zero, one = np.float32(0.0), np.float32(1.0)
    for b in range(begin, end):
        _moments(buckets, b, radius, found, places, at, sums)
        for i in range(SIZE):
            trace = sums[4, i] + sums[5, i] + sums[6, i]
            scale, whole = (np.float32(3.0) / trace, one) if trace >= least else (zero, zero)
            for k in range(4, 7):
                sums[k, i] = scale * sums[k, i] - whole
            for k in range(7, 10):
                sums[k, i] = scale * sums[k, i]
        for i in range(min(SIZE, buckets.number - b * SIZE)):
            own = made[buckets.rows[b, i]]
            own[0, 0], own[1, 1], own[2, 2] = sums[4, i], sums[5, i], sums[6, i]
            own[0, 1] = own[1, 0] = sums[7, i]
            own[0, 2] = own[2, 0] = sums[8, i]
            own[1, 2] = own[2, 1] = sums[9, i]


@compiled
def _room(buckets):  # type: ignore[no-untyped-def]
    """For all buckets, and the places and positions of all points, in full registers."""
    count = buckets.number
    return np.empty(len(buckets.rows), np.int64), np.empty(count, np.int32), np.empty((3, count + SIZE), np.float32)


@compiled
def _moments(buckets, b, radius, found, places, at, sums):  # type: ignore[no-untyped-def]
    """Of the neighbourhoods of bucket ``b``: how many they have, their mean as seen from each point, and xx, yy, zz,
    xy, xz, yz of their covariance -> (10, SIZE)."""
    x, y, z = at[0], at[1], at[2]
    n = near_bucket(buckets, b, buckets, radius * radius, found, places)
    for p in range(n):
        c, i = places[p] // SIZE, places[p] % SIZE
        x[p], y[p], z[p] = buckets.points[c, 0, i], buckets.points[c, 1, i], buckets.points[c, 2, i]
    full = -(-n // SIZE) * SIZE
    x[n:full], y[n:full], z[n:full] = _FAR, _FAR, _FAR
    for i in range(SIZE):
        px, py, pz = buckets.points[b, 0, i], buckets.points[b, 1, i], buckets.points[b, 2, i]
        (
            sums[0, i], sums[1, i], sums[2, i], sums[3, i],
            sums[4, i], sums[5, i], sums[6, i], sums[7, i], sums[8, i], sums[9, i],
        ) = _sums(x[:full], y[:full], z[:full], px, py, pz, radius * radius)  # fmt: skip
    for i in range(SIZE):
        share = np.float32(1.0) / sums[0, i]
        mx, my, mz = share * sums[1, i], share * sums[2, i], share * sums[3, i]
        sums[1, i], sums[2, i], sums[3, i] = mx, my, mz
        sums[4, i] = share * sums[4, i] - mx * mx
        sums[5, i] = share * sums[5, i] - my * my
        sums[6, i] = share * sums[6, i] - mz * mz
        sums[7, i] = share * sums[7, i] - mx * my
        sums[8, i] = share * sums[8, i] - mx * mz
        sums[9, i] = share * sums[9, i] - my * mz


@compiled_with_any_order
def _sums(xs, ys, zs, x, y, z, squared):  # type: ignore[no-untyped-def]
    """How many points are near enough, and the sums of their offsets and of the products of these."""
    zero, one = np.float32(0.0), np.float32(1.0)
    m = sx = sy = sz = sxx = syy = szz = sxy = sxz = syz = zero
    for p in range(len(xs)):
        dx, dy, dz = xs[p] - x, ys[p] - y, zs[p] - z
        near = one if dx * dx + dy * dy + dz * dz <= squared else zero
        m += near
        dx, dy, dz = near * dx, near * dy, near * dz
        sx += dx
        sy += dy
        sz += dz
        sxx += dx * dx
        syy += dy * dy
        szz += dz * dz
        sxy += dx * dy
        sxz += dx * dz
        syz += dy * dz
    return m, sx, sy, sz, sxx, syy, szz, sxy, sxz, syz


@compiled
def _turn_to_axes(work):  # type: ignore[no-untyped-def]
    """Jacobi's rotations, of SIZE symmetric tensors at a time.

    ``work`` (15, SIZE) has xx, yy, zz, xy, xz, yz of the tensors, of which the first three become the eigenvalues, in
    shares of ``_TRACE``, and the others next to nothing; then room for matrices, row after row, that have the unit
    eigenvectors as columns.
    """
    for e in range(SIZE):
        scale = _TRACE / (work[0, e] + work[1, e] + work[2, e] + _TINY)
        for k in range(6):
            work[k, e] *= scale
    work[6:] = np.float32(0.0)
    work[6], work[10], work[14] = np.float32(1.0), np.float32(1.0), np.float32(1.0)
    for _ in range(_SWEEPS):
        _rotate(work, 0, 1, 3, 4, 5)
        _rotate(work, 0, 2, 4, 3, 5)
        _rotate(work, 1, 2, 5, 3, 4)


@inlined
def _rotate(work, i, j, between, first_other, second_other):  # type: ignore[no-untyped-def]
    """The rotation in the plane of axes ``i`` and ``j`` that brings the entry ``between`` them to 0; the other two
    entries are those that they share with the third axis."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for e in range(SIZE):
        entry = work[between, e]
        difference, twice = work[j, e] - work[i, e], np.float32(2.0) * entry
        t = twice / (np.sqrt(difference * difference + twice * twice) + _TINY + abs(difference))
        t = t if difference >= zero else -t
        t = t if abs(t) > _LEAST_TURN else zero
        c = one / np.sqrt(t * t + one)
        s, change = t * c, t * entry
        a, b = work[first_other, e], work[second_other, e]
        ax, ay, az = work[6 + i, e], work[9 + i, e], work[12 + i, e]
        bx, by, bz = work[6 + j, e], work[9 + j, e], work[12 + j, e]
        work[i, e] -= change
        work[j, e] += change
        work[between, e] = zero
        work[first_other, e], work[second_other, e] = c * a - s * b, s * a + c * b
        work[6 + i, e], work[6 + j, e] = c * ax - s * bx, s * ax + c * bx
        work[9 + i, e], work[9 + j, e] = c * ay - s * by, s * ay + c * by
        work[12 + i, e], work[12 + j, e] = c * az - s * bz, s * az + c * bz
