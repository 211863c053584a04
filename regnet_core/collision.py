"""Collision of the open hand with the observed scene and with the support plane, for thousands of grasps at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.checks import check_range
from regnet_core.geometry import Array, Mask, Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.ops.cell_points import CellPoints, points_in_cells
from regnet_core.ops.compiled import compiled
from regnet_core.ops.lanes import BOXES, in_hand, number_of_bits
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import VoxelGrid, along_approach, build_grid, cell_range, cells_of_box

_CELL = 0.012
"""Edge length of the cells that points are sorted into [m]."""


@dataclass(frozen=True)
class CollisionConfig:
    """When a hand counts as colliding.

    Raises:
        InvalidInputError: a value is not a finite number of at least 0.
    """

    margin: float = 0.002
    """The bodies are grown by this much on every side but the fingers' inner faces, for the camera's noise [m]."""
    max_points: int = 1
    """Up to so many points inside a body are taken for noise."""
    table_clearance: float = 0.003
    """The least height of any part of the hand above the support plane [m]."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_range(name, value, 0.0)


class Occupancy(NamedTuple):
    """How many points lie in each part of the hand."""

    palm: npt.NDArray[np.int64]
    """(M,)."""
    fingers: npt.NDArray[np.int64]
    """(M,): both fingers together."""
    closing: npt.NDArray[np.int64]
    """(M,): between the fingers."""
    marked: npt.NDArray[np.int64]
    """(M,): those between the fingers that are marked."""


class SceneCollision:
    """Tests hands against points (N, 3), which are not copied, and a support plane."""

    def __init__(self, points: Array, plane: Plane | None, config: CollisionConfig | None = None) -> None:
        self.config = config or CollisionConfig()
        self.plane = plane
        self._points = np.ascontiguousarray(points, dtype=np.float64)

    @cached_property
    def _grid(self) -> VoxelGrid:
        return build_grid(self._points, _CELL)

    @cached_property
    def _cells(self) -> CellPoints:
        return points_in_cells(self._points, _CELL)

    def occupancy(
        self, grasps: Grasps, gripper: Gripper, *, margin: float = 0.0, marked: Mask | None = None
    ) -> Occupancy:
        """Count the points in palm, fingers and closing region of each grasp at its own opening.

        Args:
            grasps: M grasps in the frame of the points.
            gripper: the hand.
            margin: the bodies are grown by this much on every side but the fingers' inner faces [m].
            marked: (N,) which points to count in ``Occupancy.marked``; none by default.
        """
        counts = np.zeros((len(grasps), 4), np.int64)
        flags = np.zeros(len(self._grid.points), np.bool_) if marked is None else marked[self._grid.order]
        sizes, g = _sizes(gripper, margin), self._grid
        for_each_range(
            _count, len(grasps), 3000,
            grasps.rotation, grasps.translation, grasps.width, sizes, g.points, flags, g.start, g.origin, g.shape,
            g.cell, counts,
        )  # fmt: skip
        return Occupancy(*np.ascontiguousarray(counts.T))

    def with_points(self, grasps: Grasps, gripper: Gripper) -> Mask:
        """(M,): palm or fingers hit the points, of which some may be noise; positions are compared in float32."""
        hit = np.zeros(len(grasps), np.bool_)
        if len(self._points) > 0:
            for_each_range(
                _hit, len(grasps), 700,
                grasps.rotation, grasps.translation, grasps.width, _sizes(gripper, self.config.margin),
                self.config.max_points, *self._cells, hit,
            )  # fmt: skip
        return hit

    def with_table(self, grasps: Grasps, gripper: Gripper) -> Mask:
        """(M,): some part of the hand is below the support plane or nearer to it than the clearance."""
        return hits_table(grasps, gripper, self.plane, self.config)


def hits_table(grasps: Grasps, gripper: Gripper, plane: Plane | None, config: CollisionConfig) -> Mask:
    """(M,): some part of the hand is below the support plane or nearer to it than the clearance."""
    if plane is None:
        return np.zeros(len(grasps), bool)
    return lowest_height(grasps, gripper, plane) < config.table_clearance


def lowest_height(grasps: Grasps, gripper: Gripper, plane: Plane) -> Array:
    """(M,): height of the lowest corner of palm and fingers above the plane [m]."""
    normal = np.asarray(plane.normal)
    along = np.einsum("i,mij->mj", normal, grasps.rotation)
    centre = plane.height(grasps.translation)
    down_z = np.abs(along[:, 2]) * gripper.height / 2
    palm_y = np.abs(along[:, 1]) * (gripper.width / 2 + gripper.thickness)
    finger_y = np.abs(along[:, 1]) * (grasps.width / 2 + gripper.thickness)
    palm = np.minimum(0.0, -along[:, 0] * gripper.palm_depth) - palm_y
    fingers = np.minimum(0.0, along[:, 0] * gripper.depth) - finger_y
    return centre - down_z + np.minimum(palm, fingers)


def _sizes(gripper: Gripper, margin: float) -> Array:
    return np.array([gripper.width, gripper.depth, gripper.height / 2, gripper.thickness, gripper.palm_depth, margin])


@compiled
def _hit(begin, end, rotation, translation, opening, sizes, most, points, starts, low, cell, hit):  # type: ignore[no-untyped-def]
    """Whether there are more than ``most`` points in the palm, or in the fingers."""
    width, depth, half_height, thickness, palm_depth, margin = sizes
    nx, ny = starts.shape[0], starts.shape[1] - 1
    address, apart, half = points.ctypes.data, 4 * points.shape[1], half_height + margin
    for m in range(begin, end):
        pose, c = rotation[m], translation[m] - low
        inner, palm_y = opening[m] / 2, width / 2 + thickness + margin
        outer = inner + thickness + margin
        # The box around the hand, as seen from above.
        x_mid, x_half, y_max = (depth - palm_depth) / 2, (depth + palm_depth) / 2 + margin, max(palm_y, outer)
        x, y = c[0] + pose[0, 0] * x_mid, c[1] + pose[1, 0] * x_mid
        across = abs(pose[0, 0]) * x_half + abs(pose[0, 1]) * y_max + abs(pose[0, 2]) * half
        along = abs(pose[1, 0]) * x_half + abs(pose[1, 1]) * y_max + abs(pose[1, 2]) * half
        i0, i1 = cell_range(x - across, x + across, 0.0, cell, nx)
        j0, j1 = cell_range(y - along, y + along, 0.0, cell, ny)
        if j1 < j0:
            continue
        in_palm = in_fingers = 0
        for i in range(i0, i1 + 1):
            last = starts[i, j1 + 1]
            for p in range(starts[i, j0], last, BOXES):
                found = in_hand(
                    address + 4 * p, apart,
                    pose[0, 0], pose[0, 1], pose[0, 2], pose[1, 0], pose[1, 1], pose[1, 2], pose[2, 0], pose[2, 1],
                    pose[2, 2], c[0], c[1], c[2], half, -palm_depth - margin, depth + margin, margin, palm_y, inner,
                    outer,
                )  # fmt: skip
                own = (1 << min(last - p, BOXES)) - 1  # those behind are looked at with their own cells
                in_palm += number_of_bits(found & own)
                in_fingers += number_of_bits((found >> BOXES) & own)
            if in_palm > most or in_fingers > most:
                hit[m] = True
                break


@compiled
def _count(begin, end, rotation, translation, opening, sizes, points, flags, starts, origin, shape, cell, counts):  # type: ignore[no-untyped-def]
    width, depth, half_height, thickness, palm_depth, margin = sizes
    z_max = half_height + margin
    for m in range(begin, end):
        pose, c = rotation[m], translation[m]
        inner = opening[m] / 2
        outer = inner + thickness + margin
        palm_y = width / 2 + thickness + margin
        y_max = max(palm_y, outer)
        x_mid, x_half = (depth - palm_depth) / 2, (depth + palm_depth) / 2 + margin
        i0, i1, j0, j1, k0, k1 = cells_of_box(
            pose, along_approach(pose, c, x_mid), (x_half, y_max, z_max), origin, cell, shape
        )
        if k1 < k0:
            continue
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                row = (i * shape[1] + j) * shape[2]
                for p in range(starts[row + k0], starts[row + k1 + 1]):
                    dx, dy, dz = points[p, 0] - c[0], points[p, 1] - c[1], points[p, 2] - c[2]
                    z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
                    if abs(z) > z_max:
                        continue
                    x = dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]
                    if x < -palm_depth - margin or x > depth + margin:
                        continue
                    y = abs(dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1])
                    if x <= margin:
                        if y <= palm_y:
                            counts[m, 0] += 1
                    elif y < inner:
                        if x < depth and abs(z) < half_height:
                            counts[m, 2] += 1
                            counts[m, 3] += flags[p]
                    elif y <= outer:
                        counts[m, 1] += 1
