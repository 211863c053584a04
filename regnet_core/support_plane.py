"""The plane that objects stand on."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array, Plane
from regnet_core.ops.cells import Carried, carried, cells_with_points
from regnet_core.ops.rows import spread_rows, taken
from regnet_core.ops.slabs import Slabs, fitted_plane, horizontal_planes
from regnet_core.ops.voxel_grid import bounds

_CRATE, _TABLE = 0.1, 0.25
"""A level surface of less than the first area [m2] is the top of an object, one of more than the second is none."""
_CARRIED = 10
"""So many of the sampled points above a plane are something that stands on it."""
_SAMPLE, _PLENTY = 6000, 1000
"""So many points, evenly spread over the rows, are looked at; a plane that so many of these are near is not known
better by all the others."""
_PLANES, _TRIPLES = 4, 400
"""At most so many planes are looked for, each among those through so many triples of points."""
_FLAT = 0.45
"""Root mean square distance of a flat surface's points, as a share of the tolerance."""
_CELL, _GAP = 0.03, 5
"""Of maps of what a plane carries: the edge length of a cell [m], and half the width of gaps that are closed."""
_REACH = 0.5
"""What is farther above a plane does not say that the plane carries anything [m]."""
_MAP = 4_000_000
"""Cells of the largest map; where the points are spread wider, nothing is said of what planes carry."""


def fit_support_plane(
    points: npt.NDArray[np.floating],
    rng: np.random.Generator,
    *,
    max_tilt: float = math.radians(15),
    tolerance: float = 0.008,
    min_share: float = 0.05,
) -> Plane | None:
    """The plane that objects stand on, or None.

    Of several large, nearly horizontal planes it is the highest of those that carry something: a table rather than the
    floor beside it, and rather than the top of a crate on it. Where none is large, it is the one with the most points,
    unless more lie below it than on it.

    Args:
        points: (N, 3) in a gravity-aligned frame, z up [m].
        rng: source of the sampled triples (RANSAC).
        max_tilt: largest angle between the plane's normal and z [rad].
        tolerance: distance of a point that still belongs to the plane [m].
        min_share: smallest share of the points that must belong to it.
    """
    if len(points) < 50:
        return None
    sample = taken(points, spread_rows(len(points), min(len(points), _SAMPLE), rng))
    draws = rng.random((_PLANES, _TRIPLES, 3))
    found = horizontal_planes(sample, draws, math.cos(max_tilt), tolerance, min_share, _FLAT)
    chosen = _supporting(found, sample, tolerance)
    if chosen is None:
        return None
    normal, offset = found.normals[chosen], float(found.offsets[chosen])
    if len(sample) < len(points) and found.counts[chosen] < _PLENTY:
        better, at = fitted_plane(points, normal, offset, tolerance, rounds=4)
        if better[2] > math.cos(max_tilt):
            normal, offset = better, at
    return Plane((float(normal[0]), float(normal[1]), float(normal[2])), offset)


def _supporting(planes: Slabs, points: Array, tolerance: float) -> int | None:
    """Which one of the planes it is that the objects among the points (N, 3) stand on."""
    if len(planes.offsets) == 0:
        return None
    seen = _carried(planes, points, tolerance)
    large = np.flatnonzero(seen.area >= _CRATE)
    if len(large) == 0:
        height = points @ planes.normals[0] - planes.offsets[0]
        return 0 if (height <= -tolerance).sum() <= (np.abs(height) < tolerance).sum() else None
    if len(large) > 1:
        middle = np.full(len(points), 1.0 / len(points)) @ points
        large = large[np.argsort(planes.normals[large] @ middle - planes.offsets[large])]  # the highest first
        most = seen.points[large].max()
        for k in large:
            if seen.points[k] >= _CARRIED and (seen.area[k] >= _TABLE or seen.points[k] >= 0.2 * most):
                return int(k)
    return int(large[0])


def _carried(planes: Slabs, points: Array, tolerance: float) -> Carried:
    low, high = bounds(points)
    cells = (high - low)[:2] / _CELL + 1.0
    if cells[0] * cells[1] <= _MAP:
        table = np.column_stack([planes.normals, planes.offsets])
        return carried(points, table, (low, high), _CELL, tolerance, _REACH, _GAP, _CRATE)
    near = np.abs(points @ planes.normals.T - planes.offsets) < tolerance
    area = np.array([_CELL**2 * cells_with_points(points[near[:, k]], _CELL) for k in range(len(planes.offsets))])
    return Carried(area, np.zeros(len(area), np.int64))
