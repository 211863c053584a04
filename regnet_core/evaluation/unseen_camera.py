"""A camera as no data set has it: other optics, another baseline, farther away, and noisier than its own model.

What `regnet generate` draws from is `cameras/sensors.py`, `cameras/dome.py` and the paper's poses; `beyond_training`
says by how much this one is outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from regnet_core.checks import check_range
from regnet_core.data.cameras.camera import PAPER_POSES, Intrinsics
from regnet_core.data.cameras.dome import DomeConfig, dome_camera
from regnet_core.data.cameras.noise import AxialNoise, DepthNoise, axial_sigma
from regnet_core.data.cameras.rendering import TABLE_ID, SceneRenderer
from regnet_core.data.cameras.sensors import SENSORS, Sensor
from regnet_core.data.generation.making import workspace
from regnet_core.data.scenes.scene import TABLE_HEIGHT
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.evaluation.observed import POINTS, ObservedCloud, cropped_and_drawn
from regnet_core.geometry import Plane

_BASELINE, _FOCAL = 0.095, 425.0
UNSEEN = Sensor(
    "stereo_848x480",
    # Nominal for an Intel RealSense D455 at 848 x 480: 87 x 58 degrees are rounded, drivers report about 425 pixels.
    Intrinsics(848, 480, _FOCAL, _FOCAL, 423.5, 239.5),
    # A stereo pair's law with the subpixel error that sensors.py has for a D435; the rest is as plausible as there.
    DepthNoise(
        axial_model=AxialNoise(
            constant=0.0, linear=0.0, quadratic=1000.0 * 0.08 / (_FOCAL * _BASELINE), slant=0.0, slant_power=0.0
        ),
        lateral=0.6,
        correlation=1.5,
        quantum=0.001,
        disparity=_FOCAL * _BASELINE,
        disparity_step=1.0 / 32.0,
        near=0.4,
        far=6.0,
        grazing=np.radians(82.0),
        edge_width=2,
        edge_loss=0.2,
        edge_flying=0.15,
        edge_bleeding=0.35,
        dropout=0.004,
    ),
)
"""A stereo camera with nearly twice the baseline of the only stereo camera in training."""
PLACES = DomeConfig(elevation=(np.radians(65.0), np.radians(80.0)), distance=(1.66, 1.75))
"""Where it is: 1.50 to 1.72 m above the table."""
NOISE = 1.5
"""Factor on its noise."""
_DOMAIN = 0xCA3
"""Sets its random numbers apart from others of the same seed."""


@dataclass(frozen=True)
class UnseenViews:
    """Views of a data set's scenes by the unseen camera, from a place of its own for each.

    Raises:
        InvalidInputError: a number is out of range.
    """

    points: int = POINTS
    """Most points of a cloud."""
    seed: int = 0
    noise: float = NOISE
    """Factor on the noise; 0 is none."""

    def __post_init__(self) -> None:
        check_range("points", self.points, 1, 10_000_000)
        check_range("seed", self.seed, 0, 2**31 - 1)
        check_range("noise", self.noise, 0.0, 10.0)

    def __call__(self, archive: SceneArchive, scene: int, view: int) -> ObservedCloud:
        """What the camera sees of the scene; the view decides on its place and on the noise."""
        there, rng = archive.scene(scene), np.random.default_rng([_DOMAIN, self.seed, scene, view])
        camera = dome_camera(rng, UNSEEN.intrinsics, there.table, PLACES)
        noise = UNSEEN.noise.scaled(self.noise) if self.noise > 0.0 else None
        seen = SceneRenderer(there).render(camera, noise, rng, region=workspace(there.table))
        points, pixels = seen.cloud()
        chosen = cropped_and_drawn(points, seen.object_ids.ravel()[pixels] != TABLE_ID, self.points, rng)
        return ObservedCloud(points[chosen], camera.position.copy(), Plane((0.0, 0.0, 1.0), there.table_height))

    def seeded(self, seed: int) -> UnseenViews:
        return replace(self, seed=seed)

    def settings(self) -> dict[str, Any]:
        return {"clouds": UNSEEN.name, "noise": self.noise, "points": self.points, "seed": self.seed}


class Difference(NamedTuple):
    """One property of the cameras."""

    what: str
    training: str
    """Of all cameras that data sets have."""
    unseen: str


def beyond_training(noise: float = NOISE) -> list[Difference]:
    """What the unseen camera has that no camera of a data set has, from the numbers that both are made with."""
    dome, sensors, camera = DomeConfig(), list(SENSORS.values()), UNSEEN.intrinsics
    paper = [(np.hypot(x, y), z - TABLE_HEIGHT) for _, (x, y, z) in PAPER_POSES]
    heights = [*_dome_heights(dome), *(up for _, up in paper)]
    distances = [*dome.distance, *(float(np.hypot(*place)) for place in paper)]
    own_sigma = [noise * _sigma(UNSEEN, distance) for distance in PLACES.distance]
    sigma = [_sigma(sensor, dome.distance[1]) for sensor in sensors]
    baselines = [1000.0 * s.noise.disparity / s.intrinsics.fx for s in sensors if s.noise.disparity > 0.0]
    sizes = ", ".join(dict.fromkeys(f"{s.intrinsics.width} x {s.intrinsics.height}" for s in sensors))
    spacing = [1000.0 * dome.distance[1] / s.intrinsics.fx for s in sensors]
    own_spacing = [1000.0 * distance / camera.fx for distance in PLACES.distance]
    return [
        Difference("image [pixel]", sizes, f"{camera.width} x {camera.height}"),
        Difference("baseline [mm]", _range(baselines, 0), f"{1000.0 * _BASELINE:.0f}"),
        Difference("distance from the table's middle [m]", _range(distances, 2), _range(PLACES.distance, 2)),
        Difference("height above the table [m]", _range(heights, 2), _range(_dome_heights(PLACES), 2)),
        Difference("distance of pixels on the table, farthest [mm]", _range(spacing, 1), _range(own_spacing, 1)),
        Difference("depth noise, frontal, farthest [mm]", _range(sigma, 1), _range(own_sigma, 1)),
        Difference("factor on the noise model", "1", f"{noise:g}"),
    ]


def _dome_heights(dome: DomeConfig) -> tuple[float, float]:
    return tuple(d * float(np.sin(e)) for d, e in zip(dome.distance, dome.elevation, strict=True))  # type: ignore[return-value]


def _sigma(sensor: Sensor, depth: float) -> float:
    """Standard deviation of the depth of a surface that faces the camera [mm]."""
    model = sensor.noise.axial_model
    return 1000.0 * sensor.noise.axial * float(axial_sigma(np.array(depth), np.array(0.0), model))


def _range(values: Sequence[float], digits: int) -> str:
    low, high = (f"{value:.{digits}f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
