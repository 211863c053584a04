"""What is between the fingers of many hands: the points there and their normals, as each hand sees them.

The area reaches from the palm to the fingertips and from finger to finger, as the closing region does, and HALF_HEIGHT
to both sides of the plane that the fingers move in: more than a finger covers, as in the published code of GPD (0.02 m)
and of PointNetGPD (a quarter of the jaw's width, which is 0.02 m for 0.08 m). Places in it are given in units of the
area, so that the fingers are at 0 and 1 for every jaw.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array
from regnet_core.gripper import Gripper
from regnet_core.ops.box_query import Boxes, box_query
from regnet_core.pointcloud import Index

HALF_HEIGHT = 0.02
"""How far the area reaches along +Z and -Z [m]."""
Floats = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class ClosingAreas:
    """The areas of G hands; hand g has the rows ``offsets[g]`` to ``offsets[g + 1]``."""

    points: Floats
    """(E, 3): x from 0 at the palm to 1 at the fingertips, y from 0 at the -Y finger to 1 at the +Y finger, z from 0 to
    1 across."""
    normals: Floats
    """(E, 3): outward, in the frames of the hands."""
    offsets: Index
    """(G + 1,), from 0 to E."""

    def __post_init__(self) -> None:
        if len(self.points) != len(self.normals) or len(self.offsets) < 1 or self.offsets[-1] != len(self.points):
            raise InvalidInputError(
                f"closing areas need a normal for each point, and offsets that end at their number, got "
                f"{len(self.points)} points, {len(self.normals)} normals and offsets to {self.offsets[-1:]}"
            )

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @property
    def counts(self) -> Index:
        """(G,): how many points there are in each."""
        return np.diff(self.offsets)

    def take(self, some: Index) -> ClosingAreas:
        """Those with the given numbers, in that order."""
        counts = self.counts[some]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        rows = np.repeat(self.offsets[some] - offsets[:-1], counts) + np.arange(offsets[-1])
        return ClosingAreas(self.points[rows], self.normals[rows], offsets)

    def flipped(self, which: npt.NDArray[np.bool_]) -> ClosingAreas:
        """The same jaws (G,), of which some are seen in their other form: (X, -Y, -Z) instead of (X, Y, Z)."""
        turned = np.repeat(which, self.counts)[:, None] & np.array([False, True, True])
        return ClosingAreas(
            np.where(turned, 1.0 - self.points, self.points),
            np.where(turned, -self.normals, self.normals),
            self.offsets,
        )

    @classmethod
    def joined(cls, parts: list[ClosingAreas]) -> ClosingAreas:
        """All hands of several batches, in their order."""
        counts = np.concatenate([np.zeros(0, np.int64), *(part.counts for part in parts)])
        empty = np.zeros((0, 3), np.float32)
        return cls(
            np.concatenate([part.points for part in parts] or [empty]),
            np.concatenate([part.normals for part in parts] or [empty]),
            np.concatenate([[0], np.cumsum(counts)]),
        )


def closing_areas(
    rotation: Array, translation: Array, gripper: Gripper, points: Array, normals: Array, most: int = 1024
) -> ClosingAreas:
    """What of a surface is in the closing areas of hands, the jaw open at W.

    Args:
        rotation: (G, 3, 3): columns approach, closing direction, their cross product.
        translation: (G, 3): grasp centres c [m].
        gripper: the hand.
        points: (S, 3), in random order where there may be more than ``most`` [m].
        normals: (S, 3) of length 1.
        most: of more points in an area than this, the first ones are kept.
    """
    count = len(rotation)
    low = np.array([0.0, -gripper.width / 2, -HALF_HEIGHT])
    size = np.array([gripper.depth, gripper.width, 2 * HALF_HEIGHT])
    boxes = Boxes(
        *(
            torch.from_numpy(np.ascontiguousarray(value, np.float64))
            for value in (rotation, translation, np.tile(low, (count, 1)), np.tile(low + size, (count, 1)))
        )
    )
    inside = box_query(torch.from_numpy(np.ascontiguousarray(points, np.float64)), boxes, most)
    rows, owner = inside.indices.numpy(), inside.centres().numpy()
    turn = rotation[owner]
    local = np.einsum("ei,eij->ej", points[rows] - translation[owner], turn)
    return ClosingAreas(
        ((local - low) / size).astype(np.float32),
        np.einsum("ei,eij->ej", normals[rows], turn).astype(np.float32),
        inside.offsets.numpy(),
    )
