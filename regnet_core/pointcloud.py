"""Point clouds: validation, cropping, sampling and normals."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.errors import CloudError
from regnet_core.geometry import Array, Box
from regnet_core.ops.buckets import CornerBuckets
from regnet_core.ops.local_planes import LocalPlanes, local_planes
from regnet_core.ops.nearby import kth_distance
from regnet_core.ops.rows import MovedRows, Usable, chosen_rows, moved_rows, rows_in_box, usable_points, valid_rows
from regnet_core.ops.voxel_grid import bounds
from regnet_core.ops.voxels import first_in_voxels

Index = npt.NDArray[np.int64]

MAX_COORDINATE = 1000.0
"""Points farther than this from the frame's origin along an axis [m] are dropped as invalid."""
_PROBES = 64
"""Points whose neighbours are counted to know how dense a cloud is."""


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
    array = np.ascontiguousarray(as_floats(points))
    rows = valid_rows(array, MAX_COORDINATE)
    return ValidPoints(array[rows].astype(np.float64, copy=False), rows)


def place_points(
    points: npt.ArrayLike,
    T_target_source: Array,
    box: Box | None = None,
    most: int | None = None,
    seed: int = 0,
    dtype: type[np.floating] = np.float64,
    with_rows: bool = True,
) -> MovedRows:
    """What ``validate_points``, ``transform_points`` and ``crop`` do one after another, and a random draw, at once.

    Args:
        points: the user's points (M, 3) in the source frame [m].
        T_target_source: (4, 4), the pose of the source frame in the target frame.
        box: of the points to keep, in the target frame; None keeps all.
        most: how many of those are drawn at random, spread evenly over the rows; None keeps all.
        seed: of the draw.
        dtype: of the points in the target frame.
        with_rows: whether it is wanted in which rows they were.

    Raises:
        CloudError: the array is not numeric or not (M, 3).
    """
    return moved_rows(as_floats(points), T_target_source, MAX_COORDINATE, *_limits(box), most, seed, dtype, with_rows)


def usable_rows(points: npt.ArrayLike, box: Box | None = None) -> Usable:
    """Which of a user's points (M, 3) [m] ``validate_points`` and ``crop`` leave, one after another, in one pass.

    Raises:
        CloudError: the array is not numeric or not (M, 3).
    """
    return usable_points(as_floats(points), MAX_COORDINATE, *_limits(box))


def _limits(box: Box | None) -> tuple[Array, Array]:
    if box is None:
        return np.full(3, -np.inf), np.full(3, np.inf)
    return np.asarray(box.lower, np.float64), np.asarray(box.upper, np.float64)


def as_floats(points: npt.ArrayLike) -> npt.NDArray[Any]:
    """The user's points as float32 or float64 (N, 3), invalid points included.

    Raises:
        CloudError: the array is not numeric or not (N, 3).
    """
    array = as_points(points)
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


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


def voxel_downsample(points: npt.NDArray[np.floating], size: float, rows: Index | None = None) -> Index:
    """Rows of one point, the first, in each cubic voxel of edge length ``size`` [m], ascending.

    Args:
        points: (N, 3) [m].
        size: of the voxels, of which the origin is a corner [m].
        rows: (K,), ascending, of the points that there are, all within ``MAX_COORDINATE``; None: all there are.

    Raises:
        CloudError: the size is not positive.
    """
    if not size > 0:
        raise CloudError(f"the voxel size must be positive, got {size:g} m")
    there, largest = rows, MAX_COORDINATE
    if there is None:
        there, largest = np.arange(len(points)), float(np.abs(bounds(points)).max()) if len(points) > 0 else 0.0
    first = first_in_voxels(points, there, size, largest)
    if first is None:
        cells = np.floor(points[there] / size)
        first = there[np.sort(np.unique(cells, axis=0, return_index=True)[1])]
    return first


AROUND = 0.10
"""Networks see what lies so near to the objects' bounding box, when they are trained and when they detect [m]."""


def surroundings(points: npt.NDArray[np.floating], objects: npt.NDArray[np.floating]) -> Index:
    """Rows of the points (N, 3) in and near the bounding box of the objects' (K, 3) [m]; without objects all rows."""
    if len(objects) == 0:
        return np.arange(len(points))
    lower, upper = bounds(objects)
    return rows_in_box(points, lower - AROUND, upper + AROUND)


def random_sample(count: int, size: int, rng: np.random.Generator) -> Index:
    """``size`` of ``count`` indices without repetition, ascending; all of them when there are no more."""
    if count <= size:
        return np.arange(count)
    return chosen_rows(count, size, rng)


def neighbourhood_radius(points: CornerBuckets, neighbours: int = 25, low: float = 0.008, high: float = 0.02) -> float:
    """The radius [m] that holds about ``neighbours`` points of the cloud, between ``low`` and ``high``."""
    if points.buckets.number <= neighbours:
        return high
    distance = kth_distance(points.buckets, _PROBES, neighbours, max(low, 0.3 * high), 2.0 * high)
    distance.sort()
    middle = 0.5 * (distance[(len(distance) - 1) // 2] + distance[len(distance) // 2])
    return float(min(max(middle, low), high))


def estimate_normals(points: CornerBuckets, radius: float) -> LocalPlanes:
    """Local planes of points among themselves; normals have an arbitrary sign (``orient_normals``)."""
    return local_planes(points, radius)


def orient_normals(normals: Array, towards: Array) -> Array:
    """Normals (N, 3) turned so that they point along ``towards`` (N, 3) or (3,) rather than against it."""
    sign = np.where(np.sum(normals * towards, axis=-1) < 0, -1.0, 1.0)
    return normals * sign[:, None]
