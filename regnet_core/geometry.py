"""Boxes, planes and rigid transforms. SI units, right-handed frames; transforms are named ``T_target_source``."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from regnet_core.checks import as_transform, as_vector, is_number, shown
from regnet_core.errors import InvalidInputError

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in some frame [m]; ``lower`` and ``upper`` are its two extreme corners, each (3,)."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    def __post_init__(self) -> None:
        lower, upper = _corner(self.lower), _corner(self.upper)
        if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (lower < upper).all()):
            raise InvalidInputError(
                f"a box needs lower < upper in x, y and z, got lower {lower.tolist()} and upper {upper.tolist()}"
            )
        object.__setattr__(self, "lower", tuple(lower.tolist()))
        object.__setattr__(self, "upper", tuple(upper.tolist()))

    def contains(self, points: npt.ArrayLike) -> Mask:
        """Which of the points (N, 3) lie inside, the faces included -> (N,)."""
        p = np.asarray(points)
        # Corners of the points' own type: a float32 point on a face counts as inside. Integers could not hold them.
        dtype = p.dtype if p.dtype.kind == "f" else np.dtype(np.float64)
        lower, upper = np.asarray(self.lower, dtype), np.asarray(self.upper, dtype)
        return ((p >= lower) & (p <= upper)).all(axis=-1)

    def corners(self) -> Array:
        """The eight corners (8, 3)."""
        return np.array([[x, y, z] for x in self._span(0) for y in self._span(1) for z in self._span(2)])

    def _span(self, axis: int) -> tuple[float, float]:
        return self.lower[axis], self.upper[axis]


def _corner(value: npt.ArrayLike) -> Array:
    try:
        corner = np.asarray(value)
    except ValueError:  # nested sequences of different lengths
        corner = np.zeros(0)
    if corner.shape != (3,) or corner.dtype.kind not in "fiu":
        raise InvalidInputError(f"a box needs two corners of 3 numbers, got {value!r}")
    return corner.astype(np.float64)


@dataclass(frozen=True)
class Plane:
    """The plane of all p with ``normal . p = offset``; the normal has length 1 and points to the free side."""

    normal: tuple[float, float, float]
    offset: float

    def height(self, points: npt.ArrayLike) -> Array:
        """Signed distance of points (..., 3) to the plane [m], positive on the free side -> (...)."""
        return np.asarray(points) @ np.asarray(self.normal) - self.offset


def transform_points(transform: npt.ArrayLike, points: npt.ArrayLike) -> Array:
    """Points (N, 3) in the source frame, moved by ``transform`` (4, 4) into the target frame; infinity may become NaN.

    Raises:
        InvalidInputError: the transform is not a finite (4, 4) matrix.
    """
    matrix = as_transform("the transform", transform)
    with np.errstate(invalid="ignore"):
        return np.asarray(points) @ matrix[:3, :3].T + matrix[:3, 3]


def pose_matrix(xyz: npt.ArrayLike, rpy: npt.ArrayLike) -> Array:
    """The transform (4, 4) of a position [m] and roll, pitch, yaw [rad] about the fixed x, y, z axes (REP-103)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", np.asarray(rpy, float)).as_matrix()
    matrix[:3, 3] = np.asarray(xyz, float)
    return matrix


def quaternion_from_matrix(rotation: npt.ArrayLike) -> Array:
    """Rotations (M, 3, 3), which they must be, as unit quaternions (M, 4) in the order x, y, z, w, with w >= 0.

    Each from the largest of its four squares, so that nothing is divided by a small number (Shepperd, "Quaternion from
    rotation matrix", 1978). For some hundred rotations this takes a tenth of the time that scipy takes.
    """
    r = np.asarray(rotation, float)
    xx, yy, zz = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    # Each row is a multiple of the quaternion: by 4 x, 4 y, 4 z and 4 w.
    rows = np.empty((len(r), 4, 4))
    rows[:, 0, 0], rows[:, 1, 1], rows[:, 2, 2] = 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz
    rows[:, 3, 3] = 1 + xx + yy + zz
    rows[:, 0, 1] = rows[:, 1, 0] = r[:, 0, 1] + r[:, 1, 0]
    rows[:, 0, 2] = rows[:, 2, 0] = r[:, 0, 2] + r[:, 2, 0]
    rows[:, 1, 2] = rows[:, 2, 1] = r[:, 1, 2] + r[:, 2, 1]
    rows[:, 0, 3] = rows[:, 3, 0] = r[:, 2, 1] - r[:, 1, 2]
    rows[:, 1, 3] = rows[:, 3, 1] = r[:, 0, 2] - r[:, 2, 0]
    rows[:, 2, 3] = rows[:, 3, 2] = r[:, 1, 0] - r[:, 0, 1]
    largest = np.argmax(np.einsum("mii->mi", rows), axis=1)
    found: Array = rows[np.arange(len(r)), largest]
    length = np.sqrt(np.einsum("mi,mi->m", found, found))
    return found / np.where(found[:, 3] < 0.0, -length, length)[:, None]


def matrix_from_quaternion(quaternion: npt.ArrayLike) -> Array:
    """Unit quaternions (M, 4) in the order x, y, z, w as rotations (M, 3, 3)."""
    return Rotation.from_quat(np.asarray(quaternion, float)).as_matrix()


def normalised(vectors: Array) -> Array:
    """Vectors (..., 3) scaled to length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def within_cone(directions: Array, axis: npt.ArrayLike, max_angle: float) -> Mask:
    """Which unit vectors (M, 3) make an angle of at most ``max_angle`` [rad] with the axis (3,) -> (M,)."""
    return directions @ normalised(np.asarray(axis, float)) >= math.cos(max_angle) - 1e-12


def check_cone(axis: npt.ArrayLike, max_angle: float) -> None:
    """Check the two numbers that describe a cone of approach directions.

    Raises:
        InvalidInputError: the axis has no direction, or the half-angle is not in (0, pi].
    """
    if not 1e-6 < math.hypot(*as_vector("approach_axis", axis)) < 1e100:
        raise InvalidInputError(f"approach_axis must be 3 numbers, not all zero, got {axis!r}")
    if not is_number(max_angle) or not 0.0 < max_angle <= math.pi:
        raise InvalidInputError(f"approach_max_angle must be in (0, pi] rad, got {shown(max_angle)}")
