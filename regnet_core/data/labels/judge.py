"""Judges any grasps on the true scene as labels are made: exactly, and in microseconds a grasp.

What a network proposes while it trains is judged here, so that it learns how good its own grasps are. The judge of
results is another one (evaluation/ground_truth.py), which shares no code with this.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.collision import lowest_height
from regnet_core.data.labels.candidates import Floats
from regnet_core.data.labels.obstacles import obstacles_of
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.geometry import Array, Box, Mask, Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.ops.hand_mesh import HandMesh
from regnet_core.ops.triangle_tree import TriangleTree, build_tree

NOBODY = -1


class Judged(NamedTuple):
    """What is true of M grasps."""

    free: Mask
    """(M,): palm and open fingers meet neither object, fixture nor table."""
    score: Array
    """(M,): s_q; 0 where the fingers do not close on one and the same object, and where they are not free."""
    object_index: npt.NDArray[np.int64]
    """(M,): that object; NOBODY where there is none."""


class SceneJudge:
    """The judge of one scene."""

    def __init__(
        self,
        trees: Sequence[TriangleTree],
        poses: Array,
        table_height: float,
        fixtures: Sequence[Box] = (),
        clearance: float = 0.001,
    ) -> None:
        """Args:
        trees: of the meshes of the K objects.
        poses: (K, 4, 4) in the world.
        table_height: z of the table's top [m].
        fixtures: boxes in the world.
        clearance: a hand is free if it stays this far from everything [m].
        """
        self._objects = len(trees)
        self._obstacles = obstacles_of(trees, poses, fixtures)
        self._table = Plane((0.0, 0.0, 1.0), table_height)
        self._clearance = clearance

    def judge(self, rotation: Floats, translation: Floats, gripper: Gripper) -> Judged:
        """Judge grasps (M, 3, 3), (M, 3) [m] in the world, the jaw open at the gripper's W."""
        rotation, translation = np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
        m = len(rotation)
        hands = Grasps.from_poses(rotation, translation, np.full(m, gripper.width), np.zeros(m))
        free = lowest_height(hands, gripper, self._table) >= self._clearance
        high, low = _Touched(m, 1.0), _Touched(m, -1.0)
        for number, obstacle in enumerate(self._obstacles):
            owner = number if number < self._objects else NOBODY
            close, met = obstacle.meet(rotation, translation, gripper, self._clearance)
            free[close] &= ~met.collides
            high.update(close, met, owner)
            low.update(close, met, owner)
        both = free & (high.owner == low.owner) & (high.owner != NOBODY)
        return Judged(free, np.where(both, high.cosine * low.cosine, 0.0), np.where(both, high.owner, NOBODY))


class SceneJudges:
    """The judges of the scenes of a data set; what they need of its objects is kept."""

    def __init__(self, archive: SceneArchive, clearance: float = 0.001) -> None:
        self._archive, self._clearance = archive, clearance
        self._trees: dict[str, TriangleTree] = {}

    def __getitem__(self, scene: int) -> SceneJudge:
        info = self._archive.info(scene)
        trees = [self._tree(name) for name in info.objects]
        return SceneJudge(trees, info.poses, float(info.table.upper[2]), info.fixtures, self._clearance)

    def _tree(self, name: str) -> TriangleTree:
        if name not in self._trees:
            mesh = self._archive.model(name).mesh
            self._trees[name] = build_tree(mesh.vertices, mesh.faces)
        return self._trees[name]


class _Touched:
    """What the finger at +Y (side 1) or -Y (side -1) of M hands touches first."""

    def __init__(self, m: int, side: float) -> None:
        self.side = side
        self.at = np.full(m, -np.inf)
        self.cosine = np.zeros(m)
        self.owner = np.full(m, NOBODY)

    def update(self, rows: npt.NDArray[np.int64], met: HandMesh, owner: int) -> None:
        """Hands (K,) with these rows meet a solid of this number."""
        at = met.high if self.side > 0.0 else -met.low
        first = at > self.at[rows]
        rows = rows[first]
        self.at[rows], self.owner[rows] = at[first], owner
        self.cosine[rows] = (met.cos_high if self.side > 0.0 else met.cos_low)[first]
