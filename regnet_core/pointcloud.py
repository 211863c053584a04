"""Point clouds: validation, cropping, sampling, normals and the support plane."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from regnet_core.errors import CloudError
from regnet_core.geometry import Array, Box, Plane, normalised
from regnet_core.ops.local_planes import LocalPlanes, local_planes
from regnet_core.ops.voxel_grid import build_grid

Index = npt.NDArray[np.int64]

MAX_COORDINATE = 1000.0
"""Points farther than this from the frame's origin along an axis [m] are dropped as invalid."""


class ValidPoints(NamedTuple):
    """The usable points of a cloud."""

    points: Array
    """(N, 3) finite coordinates [m], float64."""
    rows: Index
    """(N,): the row of each in the user's array."""


def validate_points(points: npt.ArrayLike) -> ValidPoints:
    """Check a user's points (N, 3) [m] and drop those that are NaN, infinite or beyond ``MAX_COORDINATE``.

    Raises:
        CloudError: the array is not numeric or not (N, 3).
    """
    try:
        array = np.asarray(points)
    except (TypeError, ValueError) as error:
        raise CloudError(f"points must be an (N, 3) array of metres: {error}") from error
    if array.dtype.kind not in "fiu":
        raise CloudError(f"points must be an (N, 3) array of real numbers in metres, got dtype {array.dtype}")
    if array.ndim != 2 or array.shape[1] != 3:
        raise CloudError(
            f"points must have shape (N, 3), one row x, y, z in metres for each point, got {array.shape}"
            + ("; reshape an organised (H, W, 3) cloud by points.reshape(-1, 3)" if array.ndim == 3 else "")
        )
    array = array.astype(np.float64, copy=False)
    with np.errstate(invalid="ignore"):
        index = np.flatnonzero((np.abs(array) <= MAX_COORDINATE).all(axis=1))
    return ValidPoints(array[index], index)


def validate_colors(colors: npt.ArrayLike | None, count: int) -> npt.NDArray[np.float64] | None:
    """Colours (N, 3), uint8 0..255 or floats 0..1, as floats 0..1.

    Raises:
        CloudError: the shape does not match the points.
    """
    if colors is None:
        return None
    array = np.asarray(colors)
    if array.shape != (count, 3) or array.dtype.kind not in "fiu":
        raise CloudError(
            f"colors must have shape ({count}, 3), one row for each point, got {array.shape} {array.dtype}"
        )
    return array / 255.0 if array.dtype.kind in "iu" else array.astype(np.float64)


def crop(points: Array, box: Box) -> Index:
    """Indices of the points (N, 3) inside the box."""
    return np.flatnonzero(box.contains(points))


def voxel_downsample(points: Array, size: float) -> Index:
    """Indices of one point, the first, in each cubic voxel of edge length ``size`` [m], ascending.

    Raises:
        CloudError: the size is not positive.
    """
    if not size > 0:
        raise CloudError(f"the voxel size must be positive, got {size:g} m")
    if len(points) == 0:
        return np.zeros(0, np.int64)
    cells = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    shape = cells.max(axis=0) + 1
    if float(np.prod(shape.astype(float))) < 2**62:
        first = np.unique((cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2], return_index=True)[1]
    else:
        first = np.unique(cells, axis=0, return_index=True)[1]
    return np.sort(first)


def random_sample(count: int, size: int, rng: np.random.Generator) -> Index:
    """``size`` of ``count`` indices without repetition, ascending; all of them when there are no more."""
    if count <= size:
        return np.arange(count)
    return np.sort(rng.choice(count, size, replace=False))


def neighbourhood_radius(
    points: Array, rng: np.random.Generator, neighbours: int = 25, low: float = 0.008, high: float = 0.02
) -> float:
    """The radius [m] that holds about ``neighbours`` points of the cloud, between ``low`` and ``high``."""
    if len(points) <= neighbours:
        return high
    probes = points[random_sample(len(points), 400, rng)]
    distance = cKDTree(points).query(probes, k=[neighbours])[0]
    return float(np.clip(np.median(distance), low, high))


def estimate_normals(points: Array, radius: float) -> LocalPlanes:
    """Local planes of points (N, 3) among themselves; normals have an arbitrary sign (``orient_normals``)."""
    return local_planes(build_grid(points, max(radius, 0.005)), points, radius)


def orient_normals(normals: Array, towards: Array) -> Array:
    """Normals (N, 3) turned so that they point along ``towards`` (N, 3) or (3,) rather than against it."""
    sign = np.where(np.sum(normals * towards, axis=-1) < 0, -1.0, 1.0)
    return normals * sign[:, None]


def fit_support_plane(
    points: Array,
    rng: np.random.Generator,
    *,
    max_tilt: float = math.radians(15),
    tolerance: float = 0.008,
    min_share: float = 0.08,
) -> Plane | None:
    """The plane that objects stand on: the largest nearly horizontal one with little below it, or None.

    Args:
        points: (N, 3) in a gravity-aligned frame, z up [m].
        rng: source of the sampled triples (RANSAC).
        max_tilt: largest angle between the plane's normal and z [rad].
        tolerance: distance of a point that still belongs to the plane [m].
        min_share: smallest share of the points that must belong to it.
    """
    if len(points) < 50:
        return None
    probe = points[random_sample(len(points), 1500, rng)]
    a, b, c = (probe[rng.integers(len(probe), size=400)] for _ in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    usable = (length > 1e-5) & (np.abs(normal[:, 2]) > math.cos(max_tilt) * length)
    if not usable.any():
        return None
    normal, a = normalised(normal[usable]) * np.sign(normal[usable, 2:]), a[usable]
    distance = probe @ normal.T - np.sum(normal * a, axis=1)
    votes = (np.abs(distance) < tolerance).sum(axis=0)
    below = (distance < -3 * tolerance).sum(axis=0)
    best = int(np.argmax(votes - below))
    if votes[best] < min_share * len(probe) or below[best] > votes[best]:
        return None
    plane = _refined(points, Plane(tuple(normal[best]), float(normal[best] @ a[best])), tolerance)
    residual = plane.height(points)
    residual = residual[np.abs(residual) < tolerance]
    # Points that fill the whole slab evenly, as those of a round object do, have 0.58 of the tolerance.
    return plane if len(residual) and np.sqrt(np.mean(residual**2)) < 0.45 * tolerance else None


def _refined(points: Array, plane: Plane, tolerance: float) -> Plane:
    """Least squares on the inliers, a few times."""
    for _ in range(4):
        inliers = points[np.abs(plane.height(points)) < tolerance]
        if len(inliers) < 10:
            break
        mean = inliers.mean(axis=0)
        normal = np.linalg.eigh(np.cov((inliers - mean).T))[1][:, 0]
        normal = normal * np.sign(normal[2])
        plane = Plane((float(normal[0]), float(normal[1]), float(normal[2])), float(normal @ mean))
    return plane
