"""A bin-picking cell: a table with a bin to pick from and one to place into, a camera above, and objects.

All is in the world frame of the scenes: z up, the floor at z = 0, the table's middle over the origin. The robot stands
at the table's edge, at negative x, and looks along x.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from regnet_core.checks import check_range
from regnet_core.data.cameras.camera import Camera, look_at
from regnet_core.data.cameras.sensors import SENSORS, Sensor
from regnet_core.data.objects.library import build_object, library_specs
from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.scenes.bins import Bin, make_bin
from regnet_core.data.scenes.dropping import DropConfig, drop
from regnet_core.data.scenes.scene import Scene
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box
from regnet_core.gripper import Gripper
from regnet_core.robots.reach import work_table

_SPLIT = "test"
_POOL = 200
"""Objects of the library that are looked through."""
_SLIMMEST, _LONGEST = 0.015, 0.16
"""Objects of the cell: at least so thick, at most so long [m]."""
_ROOM = 0.75
"""Objects are at most so thick, as a share of the gripper's width."""


@dataclass(frozen=True)
class CellLayout:
    """Where things are in the cell.

    Attributes:
        pick: middle of the bin to pick from, x and y [m].
        place: middle of the bin to place into, x and y [m].
        size: of the inside of both bins, along x and y [m].
        depth: of both bins [m].
        camera_position: of the camera relative to the middle of the bin on the table's top [m].
        sensor: name of the depth camera, a key of SENSORS.

    Raises:
        InvalidInputError: a number is out of its range, there is no such camera, or the bins overlap.
    """

    pick: tuple[float, float] = (-0.02, 0.12)
    place: tuple[float, float] = (-0.02, -0.22)
    size: tuple[float, float] = (0.36, 0.30)
    depth: float = 0.08
    camera_position: tuple[float, float, float] = (0.35, 0.0, 0.75)
    sensor: str = "kinect_v2"

    def __post_init__(self) -> None:
        check_range("depth", self.depth, 0.01, 0.3, "m")
        for side in self.size:
            check_range("size", side, 0.05, 0.5, "m")
        if self.sensor not in SENSORS:
            raise InvalidInputError(f"no depth camera '{self.sensor}'; there are {', '.join(SENSORS)}")
        wall = 2.0 * 0.01
        apart = [abs(a - b) - side for a, b, side in zip(self.pick, self.place, self.size, strict=True)]
        if max(apart) < wall:
            raise InvalidInputError(f"the bins at {self.pick} and {self.place} overlap")

    @property
    def table(self) -> Box:
        """The table's top."""
        return work_table()

    @property
    def pick_bin(self) -> Bin:
        """The bin that is emptied."""
        return self._bin(self.pick)

    @property
    def place_bin(self) -> Bin:
        """The bin that is filled."""
        return self._bin(self.place)

    @property
    def fixtures(self) -> tuple[Box, ...]:
        """Floors and walls of both bins."""
        return (*self.pick_bin.boxes, *self.place_bin.boxes)

    @property
    def camera(self) -> Camera:
        """The fixed depth camera, which looks at the bin to pick from."""
        target = np.array([*self.pick, self.table.upper[2]])
        return Camera(self.device.intrinsics, look_at(target + self.camera_position, target))

    @property
    def device(self) -> Sensor:
        """The depth camera's intrinsics and noise."""
        return SENSORS[self.sensor]

    @property
    def view(self) -> Box:
        """What the camera is cropped to: the bin to pick from with its walls, and what lies in it [m]."""
        inside, wall = self.pick_bin.inside, 0.03
        (x0, y0, _), (x1, y1, rim) = inside.lower, inside.upper
        return Box((x0 - wall, y0 - wall, self.table.upper[2] - 0.05), (x1 + wall, y1 + wall, rim + 0.25))

    def _bin(self, middle: tuple[float, float]) -> Bin:
        half = 0.5 * np.array(self.size)
        return make_bin(np.array(middle) - half, np.array(middle) + half, self.table.upper[2], self.depth, 0.01)


def fill(layout: CellLayout, count: int, gripper: Gripper, seed: int) -> Scene:
    """The cell with so many objects at rest in the bin to pick from, each of a kind that the gripper can hold.

    They are of the part of the object library that no network was trained on.

    Raises:
        InvalidInputError: the count is not in [0, 20], or the gripper is too narrow for that many objects.
        SceneError: they did not come to rest in the bin.
    """
    check_range("objects", count, 0, 20)
    rng = np.random.default_rng([seed, count])
    chosen = list(islice(_graspable(gripper, rng), count))
    if len(chosen) < count:
        raise InvalidInputError(
            f"the library has {len(chosen)} objects that a gripper of {gripper.width:g} m can hold, not {count}"
        )
    scene = drop(chosen, rng, table=layout.table, config=_DROP, into=layout.pick_bin)
    return Scene(scene.objects, scene.poses, layout.table, layout.fixtures)


_DROP = DropConfig(interval=0.3, penetration=0.001, looks=2)


def _graspable(gripper: Gripper, rng: np.random.Generator) -> Iterator[ObjectModel]:
    """Objects of the library in random order that fit between the fingers and into the bin."""
    specs = library_specs(_SPLIT, _POOL)
    for i in rng.permutation(len(specs)):
        model = build_object(specs[i])
        sides = np.sort(np.ptp(model.mesh.bounding_box_oriented.vertices @ _axes(model), axis=0))
        if sides[0] >= _SLIMMEST and sides[1] <= _ROOM * gripper.width and sides[2] <= _LONGEST:
            yield model


def _axes(model: ObjectModel) -> np.ndarray:
    """(3, 3) axes of the smallest box around the object."""
    return np.asarray(model.mesh.bounding_box_oriented.primitive.transform)[:3, :3]
