"""Random cameras on a dome over a table, so that what is learnt from their views holds for any mounting."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from regnet_core.checks import check_range
from regnet_core.data.cameras.camera import Camera, Intrinsics
from regnet_core.data.cameras.sensors import Sensor
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box

TALLEST = 0.25
"""Objects reach this high above the table: a camera stays its near range away from their tops [m]."""


@dataclass(frozen=True)
class DomeConfig:
    """Where the cameras are.

    Attributes:
        elevation: least and largest angle above the table's plane [rad].
        distance: least and largest distance from the point aimed at [m].
        roll: largest turn about the viewing axis away from level, to either side [rad].
        aim: largest distance of the point aimed at from the middle of the table's top, in the table's plane [m].

    Raises:
        InvalidInputError: a number is out of range, or a range is empty.
    """

    elevation: tuple[float, float] = (np.radians(25.0), np.radians(85.0))
    distance: tuple[float, float] = (0.5, 1.3)
    roll: float = np.radians(10.0)
    aim: float = 0.05

    def __post_init__(self) -> None:
        for name, low, high in (("elevation", 0.0, 0.5 * np.pi), ("distance", 0.01, np.inf)):
            pair = getattr(self, name)
            for value in pair:
                check_range(f"DomeConfig.{name}", value, low, high)
            if pair[0] > pair[1]:
                raise InvalidInputError(f"DomeConfig.{name} is (least, largest), got {pair}")
        check_range("DomeConfig.roll", self.roll, 0.0, np.pi)
        check_range("DomeConfig.aim", self.aim, 0.0)


def dome_for(sensor: Sensor, config: DomeConfig = DomeConfig()) -> DomeConfig:
    """The dome without the places from which the sensor is too near to see the tops of objects.

    Raises:
        InvalidInputError: nothing of the dome is left.
    """
    least = max(config.distance[0], sensor.noise.near + TALLEST)
    return DomeConfig(config.elevation, (least, config.distance[1]), config.roll, config.aim)


def dome_camera(
    rng: np.random.Generator, intrinsics: Intrinsics, table: Box, config: DomeConfig = DomeConfig()
) -> Camera:
    """A camera that looks at (near) the middle of the table's top.

    Its direction is uniform over the area of the dome, its distance uniform; straight above is allowed.

    Args:
        rng: source of every random number.
        intrinsics: of the camera.
        table: the table top in the world frame [m].
        config: ranges.
    """
    elevation = np.arcsin(rng.uniform(*np.sin(config.elevation)))
    azimuth, distance = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*config.distance)
    roll = rng.uniform(-config.roll, config.roll)
    radius, angle = config.aim * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
    away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    T = np.eye(4)
    T[:3, :3] = _towards_the_middle(azimuth, away) @ Rotation.from_euler("z", roll).as_matrix()
    T[:3, 3] = _middle(table) + [radius * np.cos(angle), radius * np.sin(angle), 0.0] + distance * away
    return Camera(intrinsics, T)


def _towards_the_middle(azimuth: float, away: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axes (3, 3) of a level camera that looks against `away`; the azimuth says what is level straight above, too."""
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(-away, right), -away], axis=1)


def _middle(table: Box) -> NDArray[np.float64]:
    """(3,) middle of the table's top [m]."""
    lower, upper = np.array(table.lower), np.array(table.upper)
    return np.array([*(0.5 * (lower + upper))[:2], upper[2]])
