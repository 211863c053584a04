"""The work cell: a table, what is picked from on it, a place bin beside that, and three places for a camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from regnet_core.data.cameras.camera import PAPER_POSES, Camera, Intrinsics, from_euler, look_at
from regnet_core.data.scenes.bins import Bin, make_bin
from regnet_core.data.scenes.scene import TABLE_HEIGHT
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Box, Mask

TABLE = Box((-0.55, -0.95, TABLE_HEIGHT - 0.05), (0.55, 0.95, TABLE_HEIGHT))
"""Its top is as high as in data sets, and objects to pick are over its middle, as there."""
PICK_BIN = make_bin(np.array([-0.25, -0.2]), np.array([0.25, 0.2]), TABLE_HEIGHT, 0.12, 0.01)
"""0.50 m by 0.40 m inside, 0.12 m deep, walls and floor 1 cm thick."""
PLACE_BIN = make_bin(np.array([-0.3, 0.4]), np.array([0.3, 0.8]), TABLE_HEIGHT, 0.15, 0.01)
"""0.60 m by 0.40 m inside, 0.15 m deep."""
OPEN_SPACE = Box((-0.3, -0.3, TABLE_HEIGHT), (0.3, 0.3, TABLE_HEIGHT + 0.4))
"""What is picked from without a bin: the middle of the table."""
_AROUND = 0.05
"""So much of the table is seen around the place that is picked from [m]."""
_HEAP = 0.25
"""Objects in a bin may reach so far above its rim [m]."""


def _on_dome(azimuth: float, elevation: float, distance: float) -> Array:
    """Pose (4, 4) of a level camera that looks at the middle of the bin's floor; angles in degrees, metres."""
    a, e = np.radians([azimuth, elevation])
    target = np.array([0.0, 0.0, PICK_BIN.inside.lower[2]])
    away = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return look_at(target + distance * away, target)


CAMERA_POSES: Mapping[str, Array] = MappingProxyType(
    {
        "above": _on_dome(180.0, 80.0, 1.0),
        "front": from_euler(*PAPER_POSES[0]),
        "corner": _on_dome(-135.0, 45.0, 1.1),
    }
)
"""T_world_camera (4, 4) by name. Above: nearly straight above, 1.0 m away. Front: the paper's first pose, 50 degrees up
and 1.24 m away. Corner: over a corner of the bin, 45 degrees up and 1.1 m away."""


@dataclass(frozen=True)
class Workcell:
    """Where things are picked and placed, in the world frame [m].

    Attributes:
        table: the table top.
        source: objects with their centre in here are still to be picked.
        pick_bin: around the source; None when things are picked from the table.
        place_bin: where picked objects go.
    """

    table: Box
    source: Box
    pick_bin: Bin | None
    place_bin: Bin

    @property
    def obstacles(self) -> tuple[Box, ...]:
        """The boxes of both bins."""
        return (*(self.pick_bin.boxes if self.pick_bin else ()), *self.place_bin.boxes)

    @property
    def seen(self) -> Box:
        """What is kept of a cloud: the pick bin with its walls and no table beside it, or the middle of the table."""
        if self.pick_bin is None:
            (x0, y0, z0), (x1, y1, z1) = self.source.lower, self.source.upper
            return Box((x0 - _AROUND, y0 - _AROUND, z0 - _AROUND), (x1 + _AROUND, y1 + _AROUND, z1))
        corners = np.concatenate([box.corners() for box in self.pick_bin.boxes])
        # From half the floor's thickness up, so that the table under and beside the bin is left out.
        low = 0.5 * (corners[:, 2].min() + self.pick_bin.inside.lower[2])
        return Box((*corners[:, :2].min(axis=0), low), (*corners[:, :2].max(axis=0), self.source.upper[2]))

    @property
    def place(self) -> tuple[float, float]:
        """x and y of the middle of the place bin."""
        (x0, y0, _), (x1, y1, _) = self.place_bin.inside.lower, self.place_bin.inside.upper
        return 0.5 * (x0 + x1), 0.5 * (y0 + y1)

    def to_pick(self, poses: Array) -> Mask:
        """(K,) which objects with these poses (K, 4, 4) are still to be picked."""
        return self.source.contains(poses[:, :3, 3])

    def placed(self, poses: Array) -> Mask:
        """(K,) which objects with these poses (K, 4, 4) are in the place bin; they may lie on others, above its rim."""
        lower, upper = self.place_bin.inside.lower, self.place_bin.inside.upper
        return Box((*lower[:2], lower[2] - 0.005), (*upper[:2], upper[2] + _HEAP)).contains(poses[:, :3, 3])


def bin_workcell() -> Workcell:
    """Two bins on a table."""
    (x0, y0, floor), (x1, y1, rim) = PICK_BIN.inside.lower, PICK_BIN.inside.upper
    return Workcell(TABLE, Box((x0, y0, floor - 0.005), (x1, y1, rim + _HEAP)), PICK_BIN, PLACE_BIN)


def table_workcell() -> Workcell:
    """The open table and the place bin."""
    return Workcell(TABLE, OPEN_SPACE, None, PLACE_BIN)


def camera_at(name: str, intrinsics: Intrinsics) -> Camera:
    """The camera at one of the CAMERA_POSES.

    Raises:
        InvalidInputError: there is no such pose.
    """
    if name not in CAMERA_POSES:
        raise InvalidInputError(f"no camera pose '{name}'; there are {', '.join(CAMERA_POSES)}")
    return Camera(intrinsics, CAMERA_POSES[name])
