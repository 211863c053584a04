"""What the camera did not see: the hidden sides of objects that stand on a support plane.

A depth camera sees the front and the top of an object. Almost everything that stands on a table is solid between its
visible top and the table, so the volume below each observed point is taken as filled. The surface of that volume gives
the hidden walls, with normals; they let a grasp be judged at both contacts and keep fingers out of what is unseen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from regnet_core.geometry import Array, Plane
from regnet_core.ops.columns import smoothed_columns, surface_voxels
from regnet_core.ops.nearby import near_any
from regnet_core.pointcloud import Index

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

    def outward(self, points: Array, height: Array) -> Array:
        """Directions (N, 3), not normalised, that lead out of the solid at points (N, 3) of that height (N,) [m]."""
        where = (np.column_stack([points[:, :2], height]) - self.origin) / self.cell
        gradient = [
            ndimage.map_coordinates(self.density, (where + step).T, order=1, mode="nearest")
            - ndimage.map_coordinates(self.density, (where - step).T, order=1, mode="nearest")
            for step in 1.5 * np.eye(3)
        ]
        return -np.stack(gradient, axis=1)


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
    spread = [*np.ptp(points[:, :2], axis=0), height.max()]
    largest = 2.01 * cell
    while np.prod([side / cell + 2 * pad + 2 for side in spread]) > _MAX_VOXELS:
        cell *= 1.25
        if cell > largest:
            return None
    low = points[:, :2].min(axis=0) - pad * cell
    index = np.round((points[:, :2] - low) / cell).astype(np.int64)
    shape = index.max(axis=0) + 1 + pad
    levels = int(np.ceil(height.max() / cell)) + 1 + pad
    top = np.zeros(shape)
    np.maximum.at(top, (index[:, 0], index[:, 1]), height)
    top = np.where(top > 0, top, ndimage.grey_closing(top, size=(5, 5)))
    z = (np.arange(-pad, levels) + 0.5) * cell
    return SolidModel(smoothed_columns(top, z, smoothing, _REACH), np.array([low[0], low[1], z[0]]), cell)


def hidden_surface(
    model: SolidModel, plane: Plane, observed: Array, *, clearance: float = 0.006, min_height: float = 0.004
) -> HiddenSurface:
    """The model's surface above the plane, where no observed point (N, 3) is nearer than ``clearance`` [m]."""
    levels = model.origin[2] + np.arange(model.density.shape[2]) * model.cell
    index = surface_voxels(model.density, 0.5, int(np.count_nonzero(levels <= min_height)))
    if len(index) == 0:
        return HiddenSurface(np.zeros((0, 3)), np.zeros((0, 3)))
    grid = model.origin + index * model.cell
    gradient = np.stack([_central_difference(model.density, index, axis) for axis in range(3)], axis=1)
    slope = np.linalg.norm(gradient, axis=1)
    usable = slope > 0.05
    index, grid, slope = index[usable], grid[usable], slope[usable, None]
    normals = -gradient[usable] / slope
    # To first order the surface lies where the density has fallen to 0.5.
    excess = model.density[tuple(index.T)][:, None] - 0.5
    surface = grid + normals * model.cell * np.clip(excess / slope, 0.0, 1.0)
    nx, ny, nz = plane.normal
    z = (plane.offset + surface[:, 2] - nx * surface[:, 0] - ny * surface[:, 1]) / nz
    points = np.column_stack([surface[:, :2], z])
    far = ~near_any(observed, points, clearance)
    return HiddenSurface(points[far], normals[far])


def _central_difference(volume: Array, index: Index, axis: int) -> Array:
    """Half the difference of the two neighbours along an axis, at voxels (V, 3) that are not on the border."""
    step = np.zeros(3, np.int64)
    step[axis] = 1
    index = np.clip(index, 1, np.array(volume.shape) - 2)
    return 0.5 * (volume[tuple((index + step).T)] - volume[tuple((index - step).T)]).astype(np.float64)
