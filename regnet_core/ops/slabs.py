"""The points in a slab about a plane, how many they are, the better plane that follows from them, and what is above."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.ops.compiled import compiled, compiled_with_any_order
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.rows import blocks_of_rows

_BLOCKS = 16
"""Sums of so many blocks are added up in the same order on any number of cores."""
_PROBES = 1500
"""About so many points say which plane of many is the likeliest."""
_SHORTEST = 1e-5
"""Three points with a shorter cross product are in a line [m2]."""


class Slabs(NamedTuple):
    """Planes normal . x = offset, and the points about them."""

    normals: Array
    """(P, 3), of length 1, upwards."""
    offsets: Array
    """(P,) [m]."""
    counts: npt.NDArray[np.int64]
    """(P,): how many points are near."""


def horizontal_planes(
    points: Array,
    draws: Array,
    least_cosine: float,
    tolerance: float,
    least_share: float,
    flat: float,
) -> Slabs:
    """Nearly horizontal planes with many of the points (N, 3), about those with the most first.

    What is near one that was found does not count for the next. RANSAC (Fischler and Bolles, 1981) on some of the
    points, then least squares on all of them.

    Args:
        points: N > 0, in random order or that of a scan [m].
        draws: (P, T, 3) random numbers in [0, 1), for T triples of points for each plane.
        least_cosine: of the angle between a plane's normal and z.
        tolerance: distance of a point that is near a plane [m].
        least_share: smallest share of these some that must be near.
        flat: planes whose near points have a larger root mean square distance are left out, as a share of
            ``tolerance``; points that fill the slab, as those of a round object do, have 0.58.
    """
    planes, counts = np.empty((len(draws), 4)), np.empty(len(draws), np.int64)
    found = _horizontal(np.ascontiguousarray(points), draws, least_cosine, tolerance, least_share, flat, planes, counts)
    return Slabs(planes[:found, :3], planes[:found, 3], counts[:found])


def fitted_plane(
    points: npt.NDArray[np.floating], normal: Array, offset: float, tolerance: float, rounds: int
) -> tuple[Array, float]:
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


class Layers(NamedTuple):
    """Points above a plane and on it."""

    above: npt.NDArray[np.int64]
    """(A,): rows of those above it, ascending."""
    points: Array
    """(A, 3): these points [m]."""
    height: Array
    """(A,): how high above the plane they are [m]."""
    ground: npt.NDArray[np.float32]
    """(P, 2): x and y of points on the plane [m]."""


def layers(
    points: npt.NDArray[np.floating], normal: Array, offset: float, clearance: float, ground: int | None = None
) -> Layers:
    """What lies farther above a plane than ``clearance``, and what lies nearer.

    Args:
        points: (N, 3) [m].
        normal: (3,) of the plane, of length 1.
        offset: of the plane [m].
        clearance: [m].
        ground: about so many points of the nearer ones are enough, evenly spread over the rows; None: all.
    """
    blocks = blocks_of_rows(len(points))
    counts, each = np.zeros((blocks, 2), np.int64), len(points) / blocks
    plane = (float(normal[0]), float(normal[1]), float(normal[2]), offset)
    for_each_range(_count_layers, blocks, 1.2 * each, points, plane, clearance, counts)
    every = 1 if ground is None else max(int(counts[:, 1].sum()) // ground, 1)
    counts[:, 1] = -(-counts[:, 1] // every)
    ends = np.cumsum(counts, axis=0)
    above, on = (int(number) for number in ends[-1])
    found = Layers(np.empty(above, np.int64), np.empty((above, 3)), np.empty(above), np.empty((on, 2), np.float32))
    for_each_range(_fill_layers, blocks, 2.5 * each, points, plane, clearance, every, ends - counts, *found)
    return found


@compiled
def _count_layers(begin, end, points, plane, clearance, counts):  # type: ignore[no-untyped-def]
    a, b, c, d = plane
    for block in range(begin, end):
        above = on = 0
        for p in range(len(points) * block // len(counts), len(points) * (block + 1) // len(counts)):
            height = a * points[p, 0] + b * points[p, 1] + c * points[p, 2] - d
            above += height > clearance
            on += abs(height) <= clearance
        counts[block, 0], counts[block, 1] = above, on


@compiled
def _fill_layers(begin, end, points, plane, clearance, every, starts, above, higher, heights, ground):  # type: ignore[no-untyped-def]
    a, b, c, d = plane
    for block in range(begin, end):
        (n, m), left = starts[block], 0
        for p in range(len(points) * block // len(starts), len(points) * (block + 1) // len(starts)):
            x, y, z = points[p, 0], points[p, 1], points[p, 2]
            height = a * x + b * y + c * z - d
            if height > clearance:
                above[n], heights[n] = p, height
                higher[n, 0], higher[n, 1], higher[n, 2] = x, y, z
                n += 1
            elif height >= -clearance:
                if left == 0:
                    ground[m, 0], ground[m, 1], left = x, y, every
                    m += 1
                left -= 1


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
def _horizontal(points, draws, least_cosine, tolerance, least_share, flat, planes, counts):  # type: ignore[no-untyped-def]
    step = max(1, len(points) // _PROBES)
    probe = points[::step].copy()
    order, middle = np.argsort(probe[:, 2]), probe[len(probe) // 2]
    # Seen from one of them, float32 has digits enough.
    x = (probe[order, 0] - middle[0]).astype(np.float32)
    y = (probe[order, 1] - middle[1]).astype(np.float32)
    z = (probe[order, 2] - middle[2]).astype(np.float32)
    left, least, found = len(x), least_share * len(x), 0
    sums = np.empty((_BLOCKS, 10))
    for turn in range(len(draws)):
        if left < 3 or left < least:
            break
        normal, offset, most = _likeliest(x[:left], y[:left], z[:left], draws[turn], least_cosine, tolerance)
        if most == 0 or most < least:
            break
        n = 0
        for p in range(left):
            x[n], y[n], z[n] = x[p], y[p], z[p]
            n += abs(normal[0] * x[p] + normal[1] * y[p] + normal[2] * z[p] - offset) >= 2.0 * tolerance
        left, before = n, -1.0
        offset += normal[0] * middle[0] + normal[1] * middle[1] + normal[2] * middle[2]
        for _ in range(4):
            _sums(0, _BLOCKS, points, (normal[0], normal[1], normal[2], offset), tolerance, sums)
            before, normal, offset = _fitted(sums, normal, offset, before)
            if before < 0.0:
                break
        near, squares = 0, 0.0
        for p in range(len(points)):
            away = normal[0] * points[p, 0] + normal[1] * points[p, 1] + normal[2] * points[p, 2] - offset
            if abs(away) < tolerance:
                near += 1
                squares += away * away
        if normal[2] > least_cosine and near > 0 and np.sqrt(squares / near) < flat * tolerance:
            planes[found, :3], planes[found, 3], counts[found] = normal, offset, near
            found += 1
    return found


@compiled
def _likeliest(x, y, z, draws, least_cosine, tolerance):  # type: ignore[no-untyped-def]
    """The plane through three of the points, which ascend in z, with the most points near it, and how many.

    Points of similar height often share a horizontal plane; a tilted one needs triples from everywhere.
    """
    count, most, near = len(x), 0, np.float32(tolerance)
    normal, offset = np.zeros(3), 0.0
    for t in range(len(draws)):
        reach = count if t % 4 == 0 else max(3, count // 12)
        i = int(draws[t, 0] * count)
        j = min(max(i + int(np.rint((2.0 * draws[t, 1] - 1.0) * reach)), 0), count - 1)
        k = min(max(i + int(np.rint((2.0 * draws[t, 2] - 1.0) * reach)), 0), count - 1)
        x0, y0, z0 = np.float64(x[j] - x[i]), np.float64(y[j] - y[i]), np.float64(z[j] - z[i])
        x1, y1, z1 = np.float64(x[k] - x[i]), np.float64(y[k] - y[i]), np.float64(z[k] - z[i])
        a, b, c = y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1
        length = np.sqrt(a * a + b * b + c * c)
        if not (length > _SHORTEST and abs(c) > least_cosine * length):
            continue
        length = length if c > 0.0 else -length
        a, b, c = a / length, b / length, c / length
        d = a * x[i] + b * y[i] + c * z[i]
        n = int(_near(x, y, z, np.float32(a), np.float32(b), np.float32(c), np.float32(d), near))
        if n > most:
            most, offset = n, d
            normal[0], normal[1], normal[2] = a, b, c
    return normal, offset, most


@compiled_with_any_order
def _near(x, y, z, a, b, c, d, tolerance):  # type: ignore[no-untyped-def]
    """How many points are nearer to a plane, as a float32, of which a register holds many."""
    n, one, none = np.float32(0.0), np.float32(1.0), np.float32(0.0)
    for p in range(len(x)):
        n += one if abs(a * x[p] + b * y[p] + c * z[p] - d) < tolerance else none
    return n
