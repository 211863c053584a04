"""The solids of a scene, as hands meet them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.data.labels.candidates import Floats
from regnet_core.geometry import Array, Box, Mask
from regnet_core.gripper import Gripper
from regnet_core.ops.hand_mesh import HandMesh, box_mesh_faces, hand_on_mesh
from regnet_core.ops.triangle_tree import TriangleTree, build_tree


class Obstacle(NamedTuple):
    """A solid somewhere in the world."""

    tree: TriangleTree
    rotation: Array
    """(3, 3) and ``translation`` (3,): its pose in the world."""
    translation: Array
    lower: Array
    """(3,) and ``upper`` (3,): its bounding box in its own frame [m]."""
    upper: Array

    @classmethod
    def of_object(cls, tree: TriangleTree, pose: Array) -> Obstacle:
        """Of an object's mesh at a pose (4, 4)."""
        return cls(tree, pose[:3, :3], pose[:3, 3], tree.lower[0], tree.upper[0])

    @classmethod
    def of_box(cls, box: Box) -> Obstacle:
        """Of a box in the world."""
        return cls.of_object(build_tree(box.corners(), box_mesh_faces()), np.eye(4))

    def meet(
        self, rotation: Floats, translation: Floats, gripper: Gripper, clearance: float
    ) -> tuple[npt.NDArray[np.int64], HandMesh]:
        """What hands meet of this solid, their jaws open at W.

        Args:
            rotation: (M, 3, 3) grasp frames in the world.
            translation: (M, 3) [m].
            gripper: the hand.
            clearance: palm and fingers are grown by this on every side [m].

        Returns:
            The rows (K,) of those that are near enough to meet anything, and what these K meet.
        """
        rotation = self.rotation.T @ rotation
        translation = (translation - self.translation) @ self.rotation
        close = np.flatnonzero(self._within_reach(rotation, translation, gripper, clearance))
        opening = np.full(len(close), gripper.width)
        return close, hand_on_mesh(self.tree, rotation[close], translation[close], opening, gripper, clearance)

    def _within_reach(self, rotation: Array, translation: Array, gripper: Gripper, clearance: float) -> Mask:
        """(M,): the ball round the hand touches the bounding box."""
        middle = 0.5 * (gripper.depth - gripper.palm_depth)
        half = 0.5 * (gripper.depth + gripper.palm_depth)
        radius = np.linalg.norm([half, 0.5 * gripper.width + gripper.thickness, 0.5 * gripper.height]) + clearance
        centre = translation + middle * rotation[:, :, 0]
        outside = np.maximum(np.maximum(self.lower - centre, centre - self.upper), 0.0)
        return np.asarray(np.einsum("mi,mi->m", outside, outside) <= radius**2)


def obstacles_of(trees: Sequence[TriangleTree], poses: Array, fixtures: Sequence[Box]) -> list[Obstacle]:
    """Those of objects at poses (K, 4, 4), then those of fixtures."""
    objects = [Obstacle.of_object(tree, pose) for tree, pose in zip(trees, poses, strict=True)]
    return [*objects, *(Obstacle.of_box(box) for box in fixtures)]
