"""What the camera did not see: the hidden sides of objects that stand on a support plane.

A depth camera sees the front and the top of an object. Almost everything that stands on a table is solid between its
visible top and the table, so the volume below each observed point is taken as filled. The surface of that volume gives
the hidden walls, with normals; they let a grasp be judged at both contacts and keep fingers out of what is unseen.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from regnet_core.geometry import Array, Plane
from regnet_core.ops.cells import highest
from regnet_core.ops.columns import TOGETHER, Volume, smoothed_columns, turned_down, walls
from regnet_core.ops.nearby import near_any
from regnet_core.ops.rows import taken
from regnet_core.ops.voxel_grid import bounds

_MAX_VOXELS = 6_000_000
_MAX_LEVELS = 1000
"""And so many above each other."""
_PAD = 4
"""Cells of the grid around the objects, on every side."""
_REACH = 2.5
"""Where the smoothing ends [its standard deviations]."""


class SolidModel(NamedTuple):
    """A smoothed occupancy of the filled columns, on a grid that is aligned with the cloud's axes."""

    volume: Volume
    """The surface is where it is half filled."""
    origin: Array
    """(3,): centre of voxel (0, 0, 0): x, y in the cloud's frame and height above the plane [m]."""
    cell: float
    """Edge length of a voxel [m]."""

    def outward(self, normals: Array, points: Array, height: Array) -> Array:
        """Normals (N, 3) of length 1, turned out of the solid at points (N, 3) of that height (N,) [m]."""
        return turned_down(normals, self.volume, self.origin, self.cell, points, height, 1.5)


class HiddenSurface(NamedTuple):
    """Points on the walls of the solid that were not observed."""

    points: Array
    """(V, 3) [m]."""
    normals: Array
    """(V, 3) outward, of length 1."""

    @classmethod
    def empty(cls) -> HiddenSurface:
        """Nothing is hidden, or nobody knows what is."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)))


class Columns(NamedTuple):
    """Objects' points in vertical columns of a grid."""

    points: Array
    """(N, 3) [m]."""
    height: Array
    """(N,): above the plane that the objects stand on [m]."""
    lower: Array
    """(2,): least x and y of the points [m]."""
    upper: Array
    """(2,): greatest ones."""
    top: float
    """The greatest height [m]."""
    cell: float
    """Edge length of a cell [m]."""


def columns_of(points: Array, plane: Plane, cell: float = 0.005) -> Columns | None:
    """The columns that observed points (N, 3) of objects stand for; None where they are spread too wide or too high.

    Where the grid would be too large, its cells are enlarged, up to twice.

    Args:
        points: points of the objects only, N > 0; nothing is filled below those that are not above the plane [m].
        plane: the support plane.
        cell: edge length of a voxel [m].
    """
    height = plane.height(points)
    lower, upper = bounds(points)
    top, largest = max(float(height.max()), 0.0), 2.01 * cell
    spread = [*(upper - lower)[:2].tolist(), top]
    while math.prod(side / cell + 2 * _PAD + 2 for side in spread) > _MAX_VOXELS or top > _MAX_LEVELS * cell:
        cell *= 1.25
        if cell > largest:
            return None
    return Columns(points, height, lower[:2], upper[:2], top, cell)


def fill_columns(columns: Columns, smoothing: float = 1.2) -> SolidModel:
    """The volume between the observed points and the plane.

    Args:
        columns: of the objects.
        smoothing: standard deviation of the Gaussian that smooths the occupancy [voxels].
    """
    cell = columns.cell
    low = columns.lower - _PAD * cell
    nx, ny = np.round((columns.upper - low) / cell).astype(np.int64) + 1 + _PAD
    top = highest(columns.points, columns.height, low, cell, (int(nx), int(ny)), 2)
    levels = math.ceil(columns.top / cell) + 1 + 2 * _PAD
    z = (np.arange(-(-levels // TOGETHER) * TOGETHER) - _PAD + 0.5) * cell
    return SolidModel(smoothed_columns(top, z, smoothing, _REACH), np.array([low[0], low[1], z[0]]), cell)


def hidden_surface(
    model: SolidModel, plane: Plane, observed: Array, *, clearance: float = 0.006, min_height: float = 0.004
) -> HiddenSurface:
    """The model's surface above the plane, where no observed point (N, 3) is nearer than ``clearance`` [m]."""
    first = math.floor((min_height - model.origin[2]) / model.cell) + 1
    found = walls(model.volume, first, 0.05, model.origin, model.cell, np.array(plane.normal), plane.offset)
    far = np.flatnonzero(found.clear & ~near_any(observed, found.points, clearance))
    return HiddenSurface(taken(found.points, far), taken(found.normals, far))
