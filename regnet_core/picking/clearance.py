"""Whether a hand, on its straight way to a grasp, meets boxes that are known, such as the walls of a bin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from regnet_core.geometry import Array, Box, Mask
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper

_PARALLEL = 1e-9
"""Added where the cross product of two edges vanishes, so that rounding separates nothing."""


def meets_boxes(grasps: Grasps, gripper: Gripper, boxes: Sequence[Box], way: float, margin: float) -> Mask:
    """Which hands overlap a box, or have one between their fingers, at the grasp or on the last part of the way (M,).

    The hand moves along its approach, so what it sweeps is made of boxes too. Boxes are compared by the separating-axis
    theorem.

    Args:
        grasps: M grasps in the frame of the boxes.
        gripper: the hand, open by each grasp's `width`.
        boxes: obstacles [m].
        way: length of the straight way in [m].
        margin: obstacles are grown by so much on every side [m].
    """
    hits = np.zeros(len(grasps), dtype=bool)
    for centre, half in _swept(grasps, gripper, way):
        world = grasps.translation + centre * grasps.approach
        for box in boxes:
            lower, upper = np.array(box.lower) - margin, np.array(box.upper) + margin
            hits |= _overlap(grasps.rotation, world - 0.5 * (lower + upper), half, 0.5 * (upper - lower))
    return hits


def _swept(grasps: Grasps, gripper: Gripper, way: float) -> list[tuple[float, Array]]:
    """What the palm sweeps, and the fingers with all between them: centre along the approach, half sizes (M, 3) [m]."""
    half_height = 0.5 * gripper.height
    palm = np.full(len(grasps), 0.5 * gripper.width + gripper.thickness)
    fingers = 0.5 * grasps.width + gripper.thickness
    spans = ((-way - gripper.palm_depth, 0.0, palm), (-way, gripper.depth, fingers))
    return [
        (0.5 * (x0 + x1), np.stack([np.full(len(y), 0.5 * (x1 - x0)), y, np.full(len(y), half_height)], axis=1))
        for x0, x1, y in spans
    ]


def _overlap(rotation: Array, offset: Array, half: Array, box_half: Array) -> Mask:
    """Whether turned boxes overlap one that is not (M,).

    Args:
        rotation: (M, 3, 3) of the turned boxes.
        offset: (M, 3) from the other box's centre to theirs.
        half: (M, 3) their half sizes.
        box_half: (3,) those of the other box.
    """
    away = np.abs(rotation) + _PARALLEL
    apart = (np.abs(offset) > box_half + np.einsum("mij,mj->mi", away, half)).any(axis=1)
    local = np.einsum("mij,mi->mj", rotation, offset)
    apart |= (np.abs(local) > half + np.einsum("mij,i->mj", away, box_half)).any(axis=1)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            distance = np.abs(offset[:, k] * rotation[:, j, a] - offset[:, j] * rotation[:, k, a])
            reach = box_half[j] * away[:, k, a] + box_half[k] * away[:, j, a]
            reach = reach + half[:, b] * away[:, i, c] + half[:, c] * away[:, i, b]
            apart |= distance > reach
    return ~apart
