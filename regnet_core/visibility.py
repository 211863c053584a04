"""Which space beside the objects the camera could not see into.

Without the camera's position, the support plane tells: where the plane itself was seen, the space above it is free up
to the camera; where neither the plane nor an object was seen, some object throws its shadow, and something may hide
there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array
from regnet_core.gripper import Gripper
from regnet_core.ops.cells import seen_from_above
from regnet_core.ops.voxel_grid import bounds

_MAX_CELLS = 4_000_000
_FINGER_SAMPLES = (4, 2, 2)
"""Sample points along depth, thickness and height of a finger."""


class UnseenGround(NamedTuple):
    """A map of the support plane."""

    unseen: npt.NDArray[np.bool_]
    """(nx, ny): neither the plane nor an object was seen here."""
    origin: Array
    """(2,): centre of cell (0, 0) [m]."""
    cell: float
    """Edge length of a cell [m]."""

    def finger_shares(self, rotation: Array, translation: Array, opening: Array, gripper: Gripper) -> Array:
        """(M, 2): which part of the left (+Y) and of the right finger stands above unseen ground, in [0, 1].

        Args:
            rotation: (M, 3, 3), columns approach, closing direction and their cross product.
            translation: (M, 3), the grasp centres [m].
            opening: (M,), the jaws' openings [m].
            gripper: the hand.
        """
        nx, ny, nz = _FINGER_SAMPLES
        x = (np.arange(nx) + 0.5) / nx * gripper.depth
        y = (np.arange(ny) + 0.5) / ny * gripper.thickness
        z = ((np.arange(nz) + 0.5) / nz - 0.5) * gripper.height
        grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
        shares = []
        for side in (1.0, -1.0):
            local = np.repeat(grid[None], len(rotation), axis=0)
            local[:, :, 1] = side * (local[:, :, 1] + opening[:, None] / 2)
            points = np.einsum("mij,msj->msi", rotation[:, :2], local) + translation[:, None, :2]
            shares.append(self.at(points).mean(axis=1))
        return np.stack(shares, axis=1)

    def at(self, xy: Array) -> npt.NDArray[np.bool_]:
        """Whether the ground below points (..., 2) is unseen; outside the map it is."""
        index = np.round((xy - self.origin) / self.cell).astype(np.int64)
        inside = ((index >= 0) & (index < self.unseen.shape)).all(axis=-1)
        index = np.where(inside[..., None], index, 0)
        return ~inside | self.unseen[index[..., 0], index[..., 1]]


def unseen_ground(
    plane_points: npt.NDArray[Any], object_points: npt.NDArray[Any], cell: float = 0.006
) -> UnseenGround | None:
    """Map what was seen of the ground, from the points on the plane (P, >= 2) and on the objects (S, >= 2) [m].

    Gaps of up to two cells between points are closed. None when the map would be too large.
    """
    corners = [bounds(points) for points in (plane_points, object_points) if len(points) > 0]
    if not corners:
        return None
    pad = 4
    low = np.min([lower[:2] for lower, _ in corners], axis=0).astype(np.float64) - pad * cell
    high = np.max([upper[:2] for _, upper in corners], axis=0)
    nx, ny = (int(number) for number in np.round((high - low) / cell).astype(np.int64) + 1 + pad)
    if float(nx) * float(ny) > _MAX_CELLS:
        return None
    seen = seen_from_above((plane_points, object_points), low, cell, (nx, ny), 1)
    return UnseenGround(~seen, low, cell)
