"""Point clouds: validation, cropping, sampling, normals and the support plane."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.errors import CloudError
from regnet_core.geometry import Array, Box, Plane
from regnet_core.ops.cells import cells_with_points, count_in_slab, mark_slab
from regnet_core.ops.local_planes import LocalPlanes, local_planes
from regnet_core.ops.nearby import kth_distance
from regnet_core.ops.rows import chosen_rows, first_in_voxels, moved_rows, rows_in_box, valid_rows
from regnet_core.ops.slabs import fitted_plane, planes_of_triples, slab_counts
from regnet_core.ops.squares import closed
from regnet_core.ops.voxel_grid import bounds

Index = npt.NDArray[np.int64]

MAX_COORDINATE = 1000.0
"""Points farther than this from the frame's origin along an axis [m] are dropped as invalid."""


_CRATE, _TABLE = 0.1, 0.25
"""A level surface of less than the first area [m2] is the top of an object, one of more than the second is none."""
_PROBES = 128
"""Points whose neighbours are counted to know how dense a cloud is."""
_CARRIED = 10
"""So many of the sampled points above a plane are something that stands on it."""


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
    array = _as_floats(points)
    rows = valid_rows(array, MAX_COORDINATE)
    return ValidPoints(array[rows].astype(np.float64, copy=False), rows)


class PlacedPoints(NamedTuple):
    """The usable points of a cloud in another frame."""

    points: Array
    """(N, 3) finite coordinates in the target frame [m], float64."""
    rows: Index
    """(N,): the row of each in the user's array."""
    valid: int
    """How many points of the user's array are valid, wherever they lie."""


def place_points(points: npt.ArrayLike, T_target_source: Array, box: Box | None = None) -> PlacedPoints:
    """What ``validate_points``, ``transform_points`` and ``crop`` do one after another, in one pass.

    Args:
        points: the user's points (M, 3) in the source frame [m].
        T_target_source: (4, 4), the pose of the source frame in the target frame.
        box: of the points to keep, in the target frame; None keeps all.

    Raises:
        CloudError: the array is not numeric or not (M, 3).
    """
    lower = np.full(3, -np.inf) if box is None else np.asarray(box.lower, np.float64)
    upper = np.full(3, np.inf) if box is None else np.asarray(box.upper, np.float64)
    return PlacedPoints(*moved_rows(_as_floats(points), T_target_source, MAX_COORDINATE, lower, upper))


def _as_floats(points: npt.ArrayLike) -> npt.NDArray[Any]:
    array = as_points(points)
    return np.ascontiguousarray(array if array.dtype in (np.float32, np.float64) else array.astype(np.float64))


def as_points(points: npt.ArrayLike) -> npt.NDArray[Any]:
    """The user's points as a numeric array (N, 3), invalid points included.

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
    return array


def validate_colors(colors: npt.ArrayLike | None, count: int) -> npt.NDArray[Any] | None:
    """A user's colours (N, 3), integers 0..255 or floats 0..1, as they are (see ``colors_as_floats``).

    Raises:
        CloudError: the shape does not match the points, or a value is out of range.
    """
    if colors is None:
        return None
    try:
        array = np.asarray(colors)
    except (TypeError, ValueError) as error:
        raise CloudError(f"colors must be an array ({count}, 3), one row for each point: {error}") from error
    if array.shape != (count, 3) or array.dtype.kind not in "fiu":
        raise CloudError(
            f"colors must have shape ({count}, 3), one row for each point, got {array.shape} {array.dtype}"
        )
    if array.size and array.dtype != np.uint8:
        scaled = colors_as_floats(array)
        if not (scaled.min() >= 0.0 and scaled.max() <= 1.0):
            raise CloudError(
                f"colors must be integers in 0..255 or floats in 0..1, got values from {array.min()} to {array.max()}"
            )
    return array


def colors_as_floats(colors: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Colours (N, 3), integers 0..255 or floats 0..1, as floats 0..1; NaN becomes 0."""
    return colors / 255.0 if colors.dtype.kind in "iu" else np.nan_to_num(colors.astype(np.float64), posinf=2.0)


def validate_viewpoint(viewpoint: npt.ArrayLike | None) -> Array | None:
    """A camera's position (3,) [m].

    Raises:
        CloudError: it is not three finite numbers.
    """
    if viewpoint is None:
        return None
    try:
        position = np.asarray(viewpoint, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CloudError(f"viewpoint must be the camera's position x, y, z in metres, got {viewpoint!r}") from error
    if position.shape != (3,) or not (np.abs(position) <= MAX_COORDINATE).all():
        raise CloudError(
            f"viewpoint must be the camera's position x, y, z within {MAX_COORDINATE:g} m, got {viewpoint!r}"
        )
    return position


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
    first = first_in_voxels(points, size)
    if first is None:
        cells = np.floor((points - points.min(axis=0)) / size)
        first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    return first


AROUND = 0.10
"""Networks see what lies so near to the objects' bounding box, when they are trained and when they detect [m]."""


def surroundings(points: npt.NDArray[np.floating], objects: npt.NDArray[np.floating]) -> Index:
    """Rows of the points (N, 3) in and near the bounding box of the objects' (K, 3) [m]; without objects all rows."""
    if len(objects) == 0:
        return np.arange(len(points))
    lower, upper = bounds(objects)
    return rows_in_box(points, lower - AROUND, upper + AROUND)


_FEW = 0.25
"""A smaller share of indices is drawn one by one."""


def random_sample(count: int, size: int, rng: np.random.Generator) -> Index:
    """``size`` of ``count`` indices without repetition, ascending; all of them when there are no more."""
    if count <= size:
        return np.arange(count)
    if size < _FEW * count:
        return np.sort(rng.choice(count, size, replace=False))
    return chosen_rows(rng.random(count, dtype=np.float32), size)


def neighbourhood_radius(
    points: Array, rng: np.random.Generator, neighbours: int = 25, low: float = 0.008, high: float = 0.02
) -> float:
    """The radius [m] that holds about ``neighbours`` points of the cloud, between ``low`` and ``high``."""
    if len(points) <= neighbours:
        return high
    probes = points[random_sample(len(points), _PROBES, rng)]
    distance = kth_distance(points, probes, neighbours, max(low, 0.2 * high), 2.0 * high)
    return float(np.clip(np.median(distance), low, high))


def estimate_normals(points: Array, radius: float) -> LocalPlanes:
    """Local planes of points (N, 3) among themselves; normals have an arbitrary sign (``orient_normals``)."""
    return local_planes(points, radius)


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
    sample = points[random_sample(len(points), 6000, rng)]
    planes = _horizontal_planes(sample, rng, max_tilt, tolerance, min_share)
    if not planes:
        return None
    chosen = _supporting(planes, sample, tolerance)
    if chosen is None:
        return None
    refined = _refined(points, chosen, tolerance)
    return refined if refined.normal[2] > math.cos(max_tilt) else chosen


def _supporting(planes: list[Plane], points: Array, tolerance: float) -> Plane | None:
    """The one of the planes that the objects among the points (N, 3) stand on."""
    middle = points.mean(axis=0)
    areas = [_area(points[np.abs(plane.height(points)) < tolerance]) for plane in planes]
    large = [(plane, area) for plane, area in zip(planes, areas, strict=True) if area >= _CRATE]
    if not large:
        height = planes[0].height(points)
        return planes[0] if (height < -3 * tolerance).sum() <= (np.abs(height) < tolerance).sum() else None
    if len(large) == 1:
        return large[0][0]
    large.sort(key=lambda pair: float(pair[0].height(middle)))  # the highest first
    carried = [_carried(plane, points, tolerance) for plane, _ in large]
    for (plane, area), count in zip(large, carried, strict=True):
        if count >= _CARRIED and (area >= _TABLE or count >= 0.2 * max(carried)):
            return plane
    return large[0][0]


_RIM = 6
"""Cells around a map, one more than gaps of it are closed by."""


def _carried(plane: Plane, points: Array, tolerance: float, reach: float = 0.5, cell: float = 0.03) -> int:
    """How many of the points (N, 3) stand on the plane, up to ``reach`` [m] above where it was seen or gaps of it."""
    height = plane.height(points)
    low, high = (corner[:2] for corner in bounds(points))
    shape = ((high - low) / cell).astype(np.int64) + 1
    if float(shape[0]) * float(shape[1]) > 4e6:
        return 0
    footprint = np.zeros(shape + 2 * _RIM, np.bool_)
    mark_slab(points, height, (-tolerance, tolerance), low, cell, _RIM, footprint)
    footprint = closed(footprint, _RIM - 1)
    return count_in_slab(points, height, (2 * tolerance, reach), low, cell, _RIM, footprint)


def _horizontal_planes(
    points: Array, rng: np.random.Generator, max_tilt: float, tolerance: float, min_share: float, most: int = 4
) -> list[Plane]:
    """Planes with enough points, those with the most first; each point counts for one of them."""
    probe = points[:: max(1, len(points) // 1500)]
    left = probe[np.argsort(probe[:, 2], kind="stable")]
    planes: list[Plane] = []
    while len(planes) < most and len(left) >= min_share * len(probe):
        plane = _best_plane(left, rng, max_tilt, tolerance)
        if plane is None or (np.abs(plane.height(left)) < tolerance).sum() < min_share * len(probe):
            break
        left = left[np.abs(plane.height(left)) >= 2 * tolerance]
        plane = _refined(points, plane, tolerance)
        if plane.normal[2] > math.cos(max_tilt) and _is_flat(plane.height(points), tolerance):
            planes.append(plane)
    return planes


def _best_plane(points: Array, rng: np.random.Generator, max_tilt: float, tolerance: float) -> Plane | None:
    """The plane through three of the points (N, 3), which ascend in z, with the most points near it."""
    count = len(points)
    if count < 3:
        return None
    # Points of similar height often share a horizontal plane; a tilted one needs triples from everywhere.
    first = rng.integers(count, size=400)
    reach = np.where(np.arange(400) % 4 == 0, count, max(3, count // 12))
    step = np.round(rng.uniform(-1, 1, (400, 2)) * reach[:, None]).astype(np.int64)
    others = (first[:, None] + step).clip(0, count - 1)
    a, b, c = points[first], points[others[:, 0]], points[others[:, 1]]
    planes = planes_of_triples(a, b, c, math.cos(max_tilt), 1e-5)
    if len(planes.offsets) == 0:
        return None
    best = int(np.argmax(slab_counts(points, planes.normals, planes.offsets, tolerance)))
    return _plane(planes.normals[best], float(planes.offsets[best]))


def _is_flat(height: Array, tolerance: float) -> bool:
    """Whether the points near a plane gather at it; those of a round object fill the slab and have 0.58 of its half."""
    near = height[np.abs(height) < tolerance]
    return len(near) > 0 and float(np.sqrt(np.mean(near**2))) < 0.45 * tolerance


def _area(points: Array, cell: float = 0.03) -> float:
    """Area of the squares of a horizontal grid that points (N, 3) fall into [m2]."""
    return cell * cell * cells_with_points(points, cell)


def _refined(points: Array, plane: Plane, tolerance: float) -> Plane:
    """Least squares on the inliers, a few times or until there are as many as before."""
    return _plane(*fitted_plane(points, np.asarray(plane.normal), plane.offset, tolerance, rounds=4))


def _plane(normal: Array, offset: float) -> Plane:
    return Plane((float(normal[0]), float(normal[1]), float(normal[2])), offset)
