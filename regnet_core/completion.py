"""What the camera did not see: the hidden sides of objects that stand on a support plane.

A depth camera sees the front and the top of an object. Almost everything that stands on a table is solid between its
visible top and the table, so the volume below each observed point is taken as filled. The surface of that volume gives
the hidden walls, with normals; they let a grasp be judged at both contacts and keep fingers out of what is unseen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from regnet_core.geometry import Array, Plane
from regnet_core.ops.cells import highest
from regnet_core.ops.columns import smoothed_columns, surface_voxels, turned_down, walls
from regnet_core.ops.nearby import near_any
from regnet_core.ops.rows import taken
from regnet_core.ops.squares import closed
from regnet_core.ops.voxel_grid import bounds

_MAX_VOXELS = 6_000_000
_REACH = 2.5
"""Where the smoothing ends [its standard deviations]."""


class SolidModel(NamedTuple):
    """A smoothed occupancy of the filled columns, on a grid that is aligned with the cloud's axes."""

    density: Array
    """(nx, ny, nz) in [0, 1]; the surface is at 0.5."""
    origin: Array
    """(3,): centre of voxel (0, 0, 0): x, y in the cloud's frame and height above the plane [m]."""
    cell: float
    """Edge length of a voxel [m]."""

    def outward(self, normals: Array, points: Array, height: Array) -> Array:
        """Normals (N, 3) of length 1, turned out of the solid at points (N, 3) of that height (N,) [m]."""
        return turned_down(normals, self.density, self.origin, self.cell, points, height, 1.5)


class HiddenSurface(NamedTuple):
    """Points on the walls of the solid that were not observed."""

    points: Array
    """(V, 3) [m]."""
    normals: Array
    """(V, 3) outward, of length 1."""


def fill_columns(points: Array, plane: Plane, cell: float = 0.005, smoothing: float = 1.2) -> SolidModel | None:
    """The volume between the observed object points (N, 3) and the plane; None when it would be empty or too large.

    Where the objects are spread so wide that the grid would be too large, its cells are enlarged, up to twice.

    Args:
        points: points of the objects only, all above the plane [m].
        plane: the support plane.
        cell: edge length of a voxel [m].
        smoothing: standard deviation of the Gaussian that smooths the occupancy [voxels].
    """
    if len(points) < 10:
        return None
    pad = 4
    height = plane.height(points)
    lower, upper = bounds(points)
    spread = [*(upper - lower)[:2], height.max()]
    largest = 2.01 * cell
    while np.prod([side / cell + 2 * pad + 2 for side in spread]) > _MAX_VOXELS:
        cell *= 1.25
        if cell > largest:
            return None
    low = lower[:2] - pad * cell
    nx, ny = np.round((upper[:2] - low) / cell).astype(np.int64) + 1 + pad
    levels = int(np.ceil(height.max() / cell)) + 1 + pad
    top = highest(points, height, low, cell, (int(nx), int(ny)))
    top = np.where(top > 0, top, closed(top, 2))
    z = (np.arange(-pad, levels) + 0.5) * cell
    return SolidModel(smoothed_columns(top, z, smoothing, _REACH), np.array([low[0], low[1], z[0]]), cell)


def hidden_surface(
    model: SolidModel, plane: Plane, observed: Array, *, clearance: float = 0.006, min_height: float = 0.004
) -> HiddenSurface:
    """The model's surface above the plane, where no observed point (N, 3) is nearer than ``clearance`` [m]."""
    levels = model.origin[2] + np.arange(model.density.shape[2]) * model.cell
    index = surface_voxels(model.density, 0.5, int(np.count_nonzero(levels <= min_height)))
    found = walls(model.density, index, 0.5, 0.05)
    points = model.origin + found.points * model.cell
    nx, ny, nz = plane.normal
    points[:, 2] = (plane.offset + points[:, 2] - nx * points[:, 0] - ny * points[:, 1]) / nz
    far = np.flatnonzero(~near_any(observed, points, clearance))
    return HiddenSurface(taken(points, far), taken(found.normals, far))
