"""What the camera sees of the work cell at one moment, and what it cannot see."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from regnet_core.data.cameras.camera import Camera
from regnet_core.data.cameras.rendering import SceneRenderer
from regnet_core.data.cameras.sensors import Sensor
from regnet_core.data.scenes.scene import Scene
from regnet_core.geometry import Array, Box, Mask

_AROUND = 0.1
"""Depths are kept of what is so much beside the crop of the cloud: it may hide what is in the crop [m]."""
_BEHIND = 0.01
"""What is behind the seen surface by more than this is hidden, and not noise of the depth [m]."""


@dataclass(frozen=True, eq=False)
class Observation:
    """One view, in the world frame."""

    points: Array
    """(N, 3), the cropped cloud [m]."""
    camera: Camera
    """What it was seen by."""
    depth: Array
    """(H, W) along the camera's axis [m]; NaN where nothing is known."""

    @property
    def viewpoint(self) -> Array:
        """(3,) position of the camera [m]."""
        return self.camera.position

    def hidden(self, points: Array) -> Mask:
        """(N,) which of the points (N, 3) are behind a surface that was seen; where none was, nothing is hidden."""
        intrinsics = self.camera.intrinsics
        local = (points - self.viewpoint) @ self.camera.T_world_camera[:3, :3]
        ahead = np.maximum(local[:, 2], 1e-6)
        column = np.rint(local[:, 0] / ahead * intrinsics.fx + intrinsics.cx).astype(np.int64)
        row = np.rint(local[:, 1] / ahead * intrinsics.fy + intrinsics.cy).astype(np.int64)
        inside = (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
        seen = np.full(len(points), np.nan)
        seen[inside] = self.depth[row[inside], column[inside]]
        return np.asarray(local[:, 2] > np.nan_to_num(seen, nan=np.inf) + _BEHIND)


class DepthCamera:
    """A simulated depth camera at a place, with its noise."""

    def __init__(self, camera: Camera, sensor: Sensor, seen: Box) -> None:
        """Args: where it is, what it is, and what of the world is kept of its clouds."""
        self._camera = camera
        self._sensor = sensor
        self._seen = seen
        self._region = Box(
            tuple(np.array(seen.lower) - _AROUND), tuple(np.array(seen.upper) + np.array([_AROUND, _AROUND, 0.0]))
        )

    def look(self, scene: Scene, poses: Array, rng: np.random.Generator) -> Observation:
        """What it sees of the scene when its objects have these poses (K, 4, 4); the generator makes the noise."""
        renderer = SceneRenderer(replace(scene, poses=poses), floor=False)
        view = renderer.render(self._camera, self._sensor.noise, rng, region=self._region)
        points = view.cloud()[0]
        return Observation(points[self._seen.contains(points)], self._camera, view.depth)
