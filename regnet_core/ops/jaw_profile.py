"""Where a jaw would close: the profile of a surface along the closing direction of many candidate grasps.

For each candidate the surface points in the slab between palm and fingertips are binned along Y. The run of occupied
bins at y = 0 is the thing to be grasped; the empty runs on both sides are where fingers fit; the points at its two ends
are the contacts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.gripper import Gripper
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import VoxelGrid, along_approach, cells_of_box

_BIN = 0.002
"""Width of a bin of the profile [m]."""
_SLAB_POINTS = 4096
"""Room for the points between the pads at first; it grows for the few candidates that need more."""


class JawProfile(NamedTuple):
    """For each of C candidates; everything is 0 where ``found`` is False."""

    found: npt.NDArray[np.bool_]
    """(C,): there is something at y = 0, and room for a finger on both sides of it."""
    low: Array
    """(C,): y of the contact at the -Y finger [m]."""
    high: Array
    """(C,): y of the contact at the +Y finger [m]."""
    room: Array
    """(C,): the free length beyond the nearer obstructed contact, finger thickness included [m]."""
    cos_low: Array
    """(C,): mean over the contact patch of the cosine between its inward normal and the finger's motion, at -Y."""
    cos_high: Array
    """(C,): the same at +Y."""
    evidence: Array
    """(C,): share of the points of the less observed contact patch that the camera saw."""
    depth_low: Array
    """(C,): mean x of the contact patch at -Y [m]."""
    depth_high: Array
    """(C,): mean x of the contact patch at +Y [m]."""


def jaw_profile(
    rotation: Array,
    translation: Array,
    gripper: Gripper,
    grid: VoxelGrid,
    normals: Array,
    observed: npt.NDArray[np.bool_],
    *,
    margin: float = 0.002,
    patch: float = 0.004,
) -> JawProfile:
    """Profile of each candidate (C, 3, 3), (C, 3); ``normals`` and ``observed`` are in the order of ``grid.points``.

    Args:
        rotation: columns approach, closing direction, their cross product.
        translation: palm-side point of the closing axis y = 0 [m].
        gripper: its opening bounds the search to y in [-W, W] and its fingers set the slab and the room they need.
        grid: surface points.
        normals: (S, 3) outward.
        observed: (S,).
        margin: added around the slab, and needed on both sides of a finger [m].
        patch: points this near to the outermost one form the contact patch [m].
    """
    count = len(rotation)
    out = np.zeros((count, 8))
    found = np.zeros(count, np.bool_)
    sizes = np.array([gripper.width, gripper.depth, gripper.height / 2, gripper.thickness, margin, patch])

    for_each_range(
        _profile, count, 2000,
        rotation, translation, sizes, grid.points, normals, observed, grid.start, grid.origin, grid.shape, grid.cell,
        found, out,
    )  # fmt: skip
    return JawProfile(found, *np.ascontiguousarray(out.T))


@compiled
def _gather(pose, c, sizes, points, normals, observed, starts, origin, shape, cell, bins, ys, xs, cosines, seen):  # type: ignore[no-untyped-def]
    """Fill the profile's bins, and the lists of the points that the pads would touch; returns how many there are.

    Those that the lists have no room for are only counted.
    """
    width, depth, half_height, thickness, margin, _ = sizes
    reach = width + thickness + 2 * margin
    bins[:] = 0
    half = (depth / 2 + margin, reach, half_height + margin)
    i0, i1, j0, j1, k0, k1 = cells_of_box(pose, along_approach(pose, c, depth / 2), half, origin, cell, shape)
    n = 0
    if k1 < k0:
        return 0
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            row = (i * shape[1] + j) * shape[2]
            for p in range(starts[row + k0], starts[row + k1 + 1]):
                dx, dy, dz = points[p, 0] - c[0], points[p, 1] - c[1], points[p, 2] - c[2]
                z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
                if abs(z) > half_height + margin:
                    continue
                x = dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]
                if x < 0.0 or x > depth + margin:
                    continue
                y = dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]
                if abs(y) >= reach:
                    continue
                bins[int((y + reach) / _BIN)] += 1
                if abs(z) <= half_height and x <= depth:
                    if n < len(ys):
                        ys[n], xs[n], seen[n] = y, x, observed[p]
                        cosines[n] = (
                            normals[p, 0] * pose[0, 1] + normals[p, 1] * pose[1, 1] + normals[p, 2] * pose[2, 1]
                        )
                    n += 1
    return n


@compiled
def _occupied_run(bins, middle, need):  # type: ignore[no-untyped-def]
    """First and last bin of the occupied run at ``middle``, and the empty bins beyond each; ``need`` of them end it."""
    size = len(bins)
    begin = -1
    for offset in range(3):
        if bins[middle - offset] > 0:
            begin = middle - offset
            break
        if bins[middle + offset] > 0:
            begin = middle + offset
            break
    if begin < 0:
        return -1, -1, 0, 0
    last, free_high, b = begin, 0, begin + 1
    while b < size:
        if bins[b] > 0:
            if free_high >= need:
                break
            last, free_high = b, 0
        else:
            free_high += 1
        b += 1
    first, free_low, b = begin, 0, begin - 1
    while b >= 0:
        if bins[b] > 0:
            if free_low >= need:
                break
            first, free_low = b, 0
        else:
            free_low += 1
        b -= 1
    return first, last, free_low, free_high


@compiled
def _contact(ys, xs, cosines, seen, n, limit, sign, patch):  # type: ignore[no-untyped-def]
    """Mean cosine, observed share and mean x of the points within ``patch`` of ``limit``, inwards."""
    total, cos, seen_count, x = 0, 0.0, 0, 0.0
    for i in range(n):
        if 0.0 <= (limit - ys[i]) * sign <= patch:
            total += 1
            cos += max(0.0, sign * cosines[i])
            seen_count += seen[i]
            x += xs[i]
    if total == 0:
        return 0.0, 0.0, 0.0
    return cos / total, seen_count / total, x / total


@compiled
def _profile(  # type: ignore[no-untyped-def]
    begin, end, rotation, translation, sizes, points, normals, observed, starts, origin, shape, cell, found, out
):
    width, _, _, thickness, margin, patch = sizes
    reach = width + thickness + 2 * margin
    bins = np.zeros(int(2 * reach / _BIN) + 2, np.int32)
    room = _SLAB_POINTS
    ys, xs, cosines, seen = np.empty(room), np.empty(room), np.empty(room), np.empty(room, np.bool_)
    need = int(np.ceil((thickness + 2 * margin) / _BIN))
    for c in range(begin, end):
        n = _gather(
            rotation[c], translation[c], sizes, points, normals, observed, starts, origin, shape, cell,
            bins, ys, xs, cosines, seen,
        )  # fmt: skip
        if n > room:
            room = 2 * n
            ys, xs, cosines, seen = np.empty(room), np.empty(room), np.empty(room), np.empty(room, np.bool_)
            n = _gather(
                rotation[c], translation[c], sizes, points, normals, observed, starts, origin, shape, cell,
                bins, ys, xs, cosines, seen,
            )  # fmt: skip
        if n < 4:
            continue
        first, last, free_low, free_high = _occupied_run(bins, int(reach / _BIN), need)
        if first < 0 or free_low < need or free_high < need:
            continue
        low_edge, high_edge = first * _BIN - reach, (last + 1) * _BIN - reach
        low, high = np.inf, -np.inf
        for i in range(n):
            if low_edge <= ys[i] <= high_edge:
                low, high = min(low, ys[i]), max(high, ys[i])
        if high - low > width - 2 * margin or high <= low:
            continue
        found[c] = True
        cos_low, seen_low, x_low = _contact(ys, xs, cosines, seen, n, low, -1.0, patch)
        cos_high, seen_high, x_high = _contact(ys, xs, cosines, seen, n, high, 1.0, patch)
        out[c, 0], out[c, 1] = low, high
        out[c, 2] = min(free_low, free_high) * _BIN
        out[c, 3], out[c, 4] = cos_low, cos_high
        out[c, 5] = min(seen_low, seen_high)
        out[c, 6], out[c, 7] = x_low, x_high
