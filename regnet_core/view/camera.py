"""The camera of a picture: where it stands and how it projects."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array

_FIELD_OF_VIEW = math.radians(34)
"""Vertical; narrow enough that boxes look like boxes."""
_FILL = 0.90
"""Share of the picture that the framed points take."""
_SURROUNDINGS, _PROBES, _DIRECTIONS = 0.4, 20_000, 24
"""``clearest_azimuth`` looks at so many points within this radius [m] from so many sides."""
_NEAREST = 0.05
"""No framed point is nearer to the camera than this [m]."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; its frame has x to the right, y down and z forward."""

    rotation: Array
    """(3, 3): world to camera."""
    position: Array
    """(3,) in the world [m]."""
    focal: float
    """Focal length [pixels]."""
    size: tuple[int, int]
    """Width and height of the picture [pixels]."""

    def to_camera(self, points: npt.NDArray[np.floating[Any]]) -> Array:
        """World points (N, 3) in the camera's frame [m]."""
        return (points - self.position) @ self.rotation.T

    def project(self, points: npt.NDArray[np.floating[Any]]) -> tuple[Array, Array]:
        """World points (N, 3) -> pixels (N, 2), x to the right and y down, and depths (N,) [m]."""
        local = self.to_camera(points)
        depth = local[:, 2]
        safe = np.where(depth > 1e-6, depth, 1e-6)
        centre = np.array(self.size) / 2.0
        return local[:, :2] / safe[:, None] * self.focal + centre, depth

    def scaled(self, factor: int) -> Camera:
        """The same view with ``factor`` times as many pixels along each side."""
        return Camera(self.rotation, self.position, self.focal * factor, (self.size[0] * factor, self.size[1] * factor))


def framing_camera(points: Array, size: tuple[int, int], elevation: float, azimuth: float) -> Camera:
    """A camera that sees all the points (K, 3), as large as they fit.

    Args:
        points: what to frame [m].
        size: width and height of the picture [pixels].
        elevation: angle above the horizon [rad].
        azimuth: direction from the points to the camera about z, from x [rad].
    """
    right, back = _axes(elevation, azimuth)
    rotation = np.stack([right, np.cross(right, back), -back])
    focal = size[1] / 2 / math.tan(_FIELD_OF_VIEW / 2)
    local = points @ rotation.T
    slope = np.array(size) / 2 * _FILL / focal
    # A camera at (x, y, -d) sees a point when |X - x| <= slope (Z + d), and likewise in y. Of all the points the
    # largest X - slope Z and the smallest X + slope Z decide; half their sum is x, half their difference is slope d.
    upper = (local[:, :2] - slope * local[:, 2:]).max(axis=0)
    lower = (local[:, :2] + slope * local[:, 2:]).min(axis=0)
    distance = float(((upper - lower) / 2 / slope).max())
    distance = max(distance, _NEAREST - float(local[:, 2].min()))
    eye = np.array([*((upper + lower) / 2), -distance])
    return Camera(rotation, rotation.T @ eye, focal, size)


def clearest_azimuth(
    points: npt.NDArray[np.floating[Any]],
    target: Array,
    elevation: float,
    viewpoint: tuple[float, float, float] | None = None,
) -> float:
    """The azimuth [rad] from which a cloud (N, 3) around ``target`` (3,) shows the fewest holes.

    That is where the camera was: the shadows of the objects then hide behind the objects. Where its ``viewpoint`` is
    not known, the azimuth at which the points cover the largest area is taken.
    """
    if viewpoint is not None:
        return math.atan2(viewpoint[1] - target[1], viewpoint[0] - target[0])
    points = points[:: max(1, len(points) // _PROBES)]
    near = points[np.linalg.norm(points - target, axis=1) < _SURROUNDINGS]
    if len(near) == 0:
        return -math.pi / 2
    best, most = -math.pi / 2, -1
    cell = _SURROUNDINGS / 32
    for azimuth in np.arange(_DIRECTIONS) * 2 * math.pi / _DIRECTIONS - math.pi / 2:
        right, back = _axes(elevation, azimuth)
        seen = np.floor((near - target) @ np.stack([right, np.cross(right, back)]).T / cell).astype(np.int64)
        covered = len(np.unique(seen[:, 0] * 4096 + seen[:, 1]))
        if covered > most:
            best, most = float(azimuth), covered
    return best


def _axes(elevation: float, azimuth: float) -> tuple[Array, Array]:
    """Unit vectors to the right of the picture and from the scene to the camera."""
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    flat = math.cos(elevation)
    return right, np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
