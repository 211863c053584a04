"""The orientation coder of REGNet V2: rotation <-> (closing direction r, approach angle theta), and its canonical form.

X' is the horizontal direction r x z (z = up); the approach X is X' turned about Y = r by theta, so that
X = cos(theta) X' + sin(theta) r x X'. With a horizontal r, theta = pi / 2 points straight down and the vertical score
is 0.5 + theta / pi for |theta| <= pi / 2. A jaw is symmetric: (X, Y, Z) and (X, -Y, -Z) are the same grasp. The
canonical one has r in the half-space of the four anchors, x > 0 (on its border: y > 0, or y = 0 and z > 0).
"""

from __future__ import annotations

import numpy as np

from regnet_core.geometry import Array, normalised

_UP = np.array([0.0, 0.0, 1.0])
_FALLBACK = np.array([1.0, 0.0, 0.0])
"""X' when r is vertical and every horizontal direction is perpendicular to it."""
_VERTICAL = 1e-9
"""|r x z| below which r counts as vertical."""


def reference_direction(r: Array) -> Array:
    """X' (M, 3): the horizontal unit vector perpendicular to the closing directions r (M, 3) that theta starts from."""
    x = np.cross(r, _UP)
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    vertical = length < _VERTICAL
    return np.where(vertical, _FALLBACK, x / np.where(vertical, 1.0, length))


def canonical_rotation(rotation: Array) -> Array:
    """Each rotation (M, 3, 3) or its mirror image by the jaw's symmetry, whichever is in canonical form."""
    r = rotation[..., :, 1]
    x, y, z = r[..., 0], r[..., 1], r[..., 2]
    flip = (x < 0) | ((x == 0) & ((y < 0) | ((y == 0) & (z < 0))))
    sign = np.where(flip[..., None], -1.0, 1.0) * np.array([0.0, 1.0, 1.0]) + np.array([1.0, 0.0, 0.0])
    return rotation * sign[..., None, :]


def encode_orientation(rotation: Array) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) as canonical closing directions r (M, 3) and angles theta (M,) in (-pi, pi] [rad]."""
    canonical = canonical_rotation(rotation)
    approach, r = canonical[..., :, 0], canonical[..., :, 1]
    start = reference_direction(r)
    cos = np.sum(approach * start, axis=-1)
    sin = np.sum(approach * np.cross(r, start), axis=-1)
    theta = np.arctan2(sin, cos)
    return r, np.where(theta <= -np.pi, np.pi, theta)


def decode_orientation(r: Array, theta: Array) -> Array:
    """Rotations (M, 3, 3) of closing directions r (M, 3), of any length, and angles theta (M,) [rad]."""
    closing = normalised(r)
    start = reference_direction(closing)
    approach = np.cos(theta)[..., None] * start + np.sin(theta)[..., None] * np.cross(closing, start)
    approach = normalised(approach)
    return np.stack([approach, closing, np.cross(approach, closing)], axis=-1)


def vertical_score(rotation: Array) -> Array:
    """s_v = 0.5 + asin(-X.z) / pi of rotations (M, 3, 3) -> (M,): 1 when the hand points straight down, 0 when up."""
    return 0.5 + np.arcsin(np.clip(-rotation[..., 2, 0], -1.0, 1.0)) / np.pi
