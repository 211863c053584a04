"""Where along its closing axis, and how deep, a hand goes at a surface point without hitting what was seen.

The two-dimensional search of Grasp Pose Detection (ten Pas et al., 2017, section "Grasp candidate generation"): a hand
with a given orientation is tried at several places along its closing axis, and pushed forward along its approach until
its fingers or its palm meet a point. Of the places where it gets far enough, the middle one is taken.

The published code pushes in steps of 5 mm. How far a hand can go has a closed form: no fingertip may pass the first
point in the finger's way, and no palm the first in the palm's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.geometry import Array, Plane
from regnet_core.gripper import Gripper
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import VoxelGrid, along_approach, cells_of_box


class Placement(NamedTuple):
    """For each of C hands."""

    found: npt.NDArray[np.bool_]
    """(C,): there is a place where the hand reaches as far as it should."""
    offset: Array
    """(C,): y of the hand's middle in the frame of the surface point [m]."""
    reach: Array
    """(C,): x of the fingertips in that frame [m]."""


def place_fingers(
    rotation: Array,
    points: Array,
    gripper: Gripper,
    grid: VoxelGrid,
    plane: Plane | None,
    *,
    places: int = 10,
    least_reach: float = 0.01,
    margin: float = 0.002,
    clearance: float = 0.003,
) -> Placement:
    """Place hands with the jaw open at W.

    Args:
        rotation: (C, 3, 3): columns approach, closing direction, their cross product.
        points: (C, 3): a surface point for each hand, which comes to lie between its fingers [m].
        gripper: the hand.
        grid: the points that it must not hit.
        plane: the support plane, if there is one.
        places: how many places along the closing axis are tried, over the jaw's width.
        least_reach: how far beyond the surface point the fingertips must get [m].
        margin: the bodies are grown by this on every side but the fingers' inner faces [m].
        clearance: how far the whole hand stays above the plane [m].
    """
    count = len(rotation)
    found, offset, reach = np.zeros(count, np.bool_), np.zeros(count), np.zeros(count)
    sizes = np.array(
        [gripper.width, gripper.depth, gripper.height / 2, gripper.thickness, gripper.palm_depth, margin, least_reach]
    )
    limit = _limits_of_plane(rotation, points, gripper, plane, clearance)
    g = grid

    for_each_range(
        _place, count, 5000,
        rotation, points, sizes, places, limit, g.points, g.start, g.origin, g.shape, g.cell, found, offset, reach,
    )  # fmt: skip
    return Placement(found, offset, reach)


def _limits_of_plane(
    rotation: Array, points: Array, gripper: Gripper, plane: Plane | None, clearance: float
) -> tuple[Array, Array]:
    """The greatest reach (C,) [m] of hands in the middle, and how it changes with their offset (C,)."""
    count = len(rotation)
    if plane is None:
        return np.full(count, np.inf), np.zeros(count)
    along = np.einsum("i,cij->cj", np.asarray(plane.normal), rotation)
    half = np.abs(along[:, 1]) * (gripper.width / 2 + gripper.thickness) + np.abs(along[:, 2]) * gripper.height / 2
    room = plane.height(points) - half - clearance
    down = -along[:, 0]
    # A hand that does not go down gets no lower by going on: its rear decides, which the collision check looks at.
    goes_down = down > 1e-6
    safe = np.where(goes_down, down, 1.0)
    return np.where(goes_down, room / safe, np.inf), np.where(goes_down, along[:, 1] / safe, 0.0)


@compiled
def _place(  # type: ignore[no-untyped-def]
    begin, end, rotation, at, sizes, places, limit, points, starts, origin, shape, cell, found, offset, reach
):
    width, depth, half_height, thickness, palm_depth, margin, least = sizes
    farthest = np.empty(places)
    outer, inner = width / 2 + thickness + margin, width / 2
    back = least - depth - palm_depth - margin
    half = ((depth - back) / 2 + margin, width / 2 + outer, half_height + margin)
    for c in range(begin, end):
        pose, p0 = rotation[c], at[c]
        for k in range(places):
            y = ((k + 0.5) / places - 0.5) * width
            farthest[k] = min(depth, limit[0][c] + limit[1][c] * y)
        middle = along_approach(pose, p0, (depth + back) / 2)
        i0, i1, j0, j1, k0, k1 = cells_of_box(pose, middle, half, origin, cell, shape)
        if k1 < k0:
            continue
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                row = (i * shape[1] + j) * shape[2]
                for p in range(starts[row + k0], starts[row + k1 + 1]):
                    dx, dy, dz = points[p, 0] - p0[0], points[p, 1] - p0[1], points[p, 2] - p0[2]
                    z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
                    if abs(z) > half_height + margin:
                        continue
                    x = dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]
                    if x < back or x > depth + margin:
                        continue
                    y = dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]
                    for k in range(places):
                        beside = abs(y - ((k + 0.5) / places - 0.5) * width)
                        if beside <= outer:
                            # The palm stops at the point, or, in a finger's way, the fingertip does.
                            stop = x - margin if beside >= inner else x - margin + depth
                            farthest[k] = min(farthest[k], stop)
        good = 0
        for k in range(places):
            good += farthest[k] >= least
        if good == 0:
            continue
        wanted = (good + 1) // 2
        for k in range(places):
            wanted -= farthest[k] >= least
            if wanted == 0:
                found[c] = True
                offset[c] = ((k + 0.5) / places - 0.5) * width
                reach[c] = farthest[k]
                break
