"""Poses on the way to and from a grasp: before the approach and after the lift."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array


def pre_grasp_poses(poses: npt.ArrayLike, distance: float) -> Array:
    """Grasp poses (M, 4, 4) moved back by ``distance`` [m] along their own approach axis X -> (M, 4, 4).

    Raises:
        InvalidInputError: the distance is negative or not finite.
    """
    _check("pre-grasp distance", distance)
    moved = np.array(poses, dtype=float)
    moved[:, :3, 3] -= distance * moved[:, :3, 0]
    return moved


def lift_poses(poses: npt.ArrayLike, height: float) -> Array:
    """Grasp poses (M, 4, 4) in a gravity-aligned frame moved up by ``height`` [m] along its z -> (M, 4, 4).

    Raises:
        InvalidInputError: the height is negative or not finite.
    """
    _check("lift height", height)
    moved = np.array(poses, dtype=float)
    moved[:, 2, 3] += height
    return moved


def _check(name: str, length: float) -> None:
    if not (math.isfinite(length) and length >= 0.0):
        raise InvalidInputError(f"the {name} must be a number of metres, 0 or more, got {length:g}")
