"""What the camera sees of the work cell at one moment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from regnet_core.data.cameras.camera import Camera
from regnet_core.data.cameras.rendering import SceneRenderer
from regnet_core.data.cameras.sensors import Sensor
from regnet_core.data.scenes.scene import Scene
from regnet_core.geometry import Array, Box


@dataclass(frozen=True, eq=False)
class Observation:
    """One cloud, in the world frame."""

    points: Array
    """(N, 3), cropped [m]."""
    viewpoint: Array
    """(3,) position of the camera [m]."""


class DepthCamera:
    """A simulated depth camera at a place, with its noise."""

    def __init__(self, camera: Camera, sensor: Sensor, seen: Box) -> None:
        """Args: where it is, what it is, and what of the world is kept of its clouds."""
        self._camera = camera
        self._sensor = sensor
        self._seen = seen

    def look(self, scene: Scene, poses: Array, rng: np.random.Generator) -> Observation:
        """What it sees of the scene when its objects have these poses (K, 4, 4); the generator makes the noise."""
        renderer = SceneRenderer(replace(scene, poses=poses), floor=False)
        view = renderer.render(self._camera, self._sensor.noise, rng, region=self._seen)
        return Observation(view.cloud()[0], self._camera.position.copy())
