"""Grasp labels of a scene: every object's own grasps that its surroundings leave free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from regnet_core.checks import check_range
from regnet_core.coder import canonical_rotation
from regnet_core.collision import lowest_height
from regnet_core.data.labels.candidates import Candidates, Floats
from regnet_core.data.labels.obstacles import Obstacle, obstacles_of
from regnet_core.data.scenes.scene import Scene
from regnet_core.geometry import Array, Mask, Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.ops.hand_mesh import CONTACT_DEPTH
from regnet_core.ops.triangle_tree import TriangleTree, build_tree


@dataclass(frozen=True)
class LabelConfig:
    """Which grasps a scene keeps.

    Raises:
        InvalidInputError: a number is out of range.
    """

    clearance: float = 0.002
    """Palm and fingers stay at least this far from other objects, fixtures and the table [m]."""
    steepest_rise: float = 0.2
    """Largest z of the approach: a hand that comes from below has its arm in the table."""
    per_point: int = 2
    """Grasps kept of one sampled surface point: the one with the best score and others drawn at random."""
    per_object: int = 300
    """Most grasps kept of one object, drawn at random."""

    def __post_init__(self) -> None:
        check_range("clearance", self.clearance, 0.0)
        check_range("steepest_rise", self.steepest_rise, -1.0, 1.0)
        for name in ("per_point", "per_object"):
            check_range(name, getattr(self, name), 1)


@dataclass(frozen=True)
class GraspLabels:
    """M grasps of a scene for one gripper, the jaw open at W, in the world frame."""

    translation: Floats
    """(M, 3): grasp centres c [m]."""
    rotation: Floats
    """(M, 3, 3): columns approach X, closing direction Y, Z, in canonical form."""
    score: Floats
    """(M,): s_q = cos(alpha_i) cos(alpha_j) at the two true contacts."""
    contacts: Floats
    """(M, 2): y of the contacts of the fingers at -Y and at +Y in the grasp frame [m]."""
    entry: Floats
    """(M,): x at which the approach axis enters the object [m]."""
    object_index: npt.NDArray[np.int64]
    """(M,): the object that is grasped."""

    def __len__(self) -> int:
        return len(self.score)

    def __getitem__(self, chosen: npt.NDArray[np.generic] | slice) -> GraspLabels:
        return GraspLabels(*(getattr(self, f.name)[chosen] for f in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence[GraspLabels]) -> GraspLabels:
        """All grasps of several batches, in their order."""
        parts = [cls.empty(), *parts]
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    @classmethod
    def empty(cls) -> GraspLabels:
        """A batch without a grasp."""
        return cls(
            np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64)
        )

    @property
    def entry_points(self) -> Floats:
        """(M, 3): where the approach axes enter the objects [m]."""
        return self.translation + self.entry[:, None] * self.rotation[:, :, 0]

    def centre_score(self, width: float) -> Floats:
        """(M,) in [0, 1]: how well the contacts are centred in a jaw open by ``width`` [m]; 1 in the very middle.

        One minus the distance of the contacts' middle from the jaw's, in units of half the opening.
        """
        return 1.0 - np.abs(self.contacts.sum(axis=1)) / width

    def grasps(self, width: float) -> Grasps:
        """The same as ``Grasps`` with the jaw open by ``width`` [m]."""
        return Grasps.from_poses(self.rotation, self.translation, np.full(len(self), width), self.score)


class LabelledScene(NamedTuple):
    """The labels of one scene and one gripper."""

    kept: GraspLabels
    """What is stored."""
    best: GraspLabels
    """The best grasp of every sampled surface point that has any: the measure of how graspable a place is."""
    found: int
    """How many grasps there were in all."""


class SceneLabeller:
    """Labels one scene for any number of grippers."""

    def __init__(self, scene: Scene, config: LabelConfig | None = None, trees: Sequence[TriangleTree] = ()) -> None:
        """Args: the scene, and the trees of its objects' meshes where they are at hand already."""
        self.scene = scene
        self.config = config or LabelConfig()
        own = trees or [build_tree(model.mesh.vertices, model.mesh.faces) for model in scene.objects]
        self._obstacles = obstacles_of(own, scene.poses, scene.fixtures)
        self._table = Plane((0.0, 0.0, 1.0), scene.table_height)

    def label(self, candidates: Sequence[Candidates], gripper: Gripper, rng: np.random.Generator) -> LabelledScene:
        """Transform each object's candidates into the scene and keep those that nothing else is in the way of.

        Args:
            candidates: for each object those for this gripper.
            gripper: the hand, open at W.
            rng: which grasps are kept where there are more than asked for.
        """
        kept, best, found = [], [], 0
        for index, own in enumerate(candidates):
            free = self._free(index, own, gripper)
            free = free.take(rng.permutation(len(free)))
            rank = _rank_at_point(free)
            kept.append(self._labels(index, free.take(self._thin(rank, rng))))
            best.append(self._labels(index, free.take(np.flatnonzero(rank == 0))))
            found += len(free)
        return LabelledScene(GraspLabels.concatenate(kept), GraspLabels.concatenate(best), found)

    def _free(self, index: int, own: Candidates, gripper: Gripper) -> Candidates:
        """Those of an object's candidates that are free in the scene, in the world frame."""
        pose = self.scene.poses[index]
        rotation, translation = pose[:3, :3] @ own.rotation, own.translation @ pose[:3, :3].T + pose[:3, 3]
        own = replace(own, rotation=rotation, translation=translation)
        own = own.take(own.rotation[:, 2, 0] <= self.config.steepest_rise)
        opening = np.full(len(own), gripper.width)
        hands = Grasps.from_poses(own.rotation, own.translation, opening, own.score)
        own = own.take(lowest_height(hands, gripper, self._table) >= self.config.clearance)
        for number, obstacle in enumerate(self._obstacles):
            if number != index:
                own = own.take(self._leaves_free(obstacle, own, gripper))
        return own

    def _leaves_free(self, obstacle: Obstacle, own: Candidates, gripper: Gripper) -> Mask:
        """(M,): the hand does not meet this solid, and closes on its object before it could touch this one."""
        close, met = obstacle.meet(own.rotation, own.translation, gripper, self.config.clearance)
        first = (met.high > own.high[close] - CONTACT_DEPTH) | (met.low < own.low[close] + CONTACT_DEPTH)
        free = np.ones(len(own), np.bool_)
        free[close] = ~(met.collides | (np.isfinite(met.high) & first))
        return free

    def _thin(self, rank: npt.NDArray[np.int64], rng: np.random.Generator) -> npt.NDArray[np.int64]:
        """Which candidates are kept, given each one's rank at its surface point."""
        kept = np.flatnonzero(rank < self.config.per_point)
        if len(kept) > self.config.per_object:
            kept = rng.choice(kept, self.config.per_object, replace=False)
        return np.sort(kept)

    def _labels(self, index: int, own: Candidates) -> GraspLabels:
        canonical, contacts = canonical_jaw(own.rotation, np.stack([own.low, own.high], axis=1))
        return GraspLabels(
            own.translation, canonical, own.score, contacts, own.entry, np.full(len(own), index, np.int64)
        )


def canonical_jaw(rotation: Floats, contacts: Floats) -> tuple[Array, Floats]:
    """Rotations (M, 3, 3) in canonical form, and the contacts (M, 2) at -Y and +Y in their frames."""
    canonical = canonical_rotation(np.asarray(rotation, np.float64))
    # In the mirrored frame of a turned jaw, the finger at +Y is the other one.
    turned = np.einsum("mi,mi->m", canonical[:, :, 1], rotation[:, :, 1]) < 0.0
    return canonical, np.where(turned[:, None], -contacts[:, ::-1], contacts)


def _rank_at_point(own: Candidates) -> npt.NDArray[np.int64]:
    """(M,): 0 for the best candidate of each surface point, and 1, 2 ... for the others in the order they come in."""
    order = np.lexsort((-own.score, own.point))
    first = order[np.unique(own.point[order], return_index=True)[1]]
    is_best = np.zeros(len(own), np.bool_)
    is_best[first] = True
    order = np.lexsort((~is_best, own.point))
    _, start, size = np.unique(own.point[order], return_index=True, return_counts=True)
    rank = np.empty(len(own), np.int64)
    rank[order] = np.arange(len(own)) - np.repeat(start, size)
    return rank


def rotation_from_quaternion(quaternion: Array) -> Array:
    """Rotations (M, 3, 3) of quaternions (M, 4) in the order x, y, z, w, of any length."""
    return Rotation.from_quat(quaternion).as_matrix() if len(quaternion) else np.zeros((0, 3, 3))
