"""Sets of objects for picking, drawn from the test split of the library by what is measured on their meshes.

Three numbers decide, for a jaw that opens by JAW. An object comes to rest on one of the faces of its convex hull; the
quasi-static probability of each (trimesh, after Goldberg et al. 1999) weighs what is found there.

    solidity    volume over that of the convex hull: 1 without hollows
    fit         share of the resting poses in which the jaw goes across the whole object from above: its least
                horizontal extent is at most FILL of the opening, and it is at least LOWEST high
    graspable   share of the resting poses in which there are grasps from above: hands within 45 degrees of straight
                down that meet neither the object nor the ground it lies on, with s_q of at least 0.8

Easy objects have a fit of at least 0.9 and a solidity of at least 0.8: compact shapes that fit the jaw however they
lie. Hard ones are all others: thin, flat, large, concave, of which only a part fits the jaw, or only in some poses.
Both are graspable in three quarters of their poses, so that there is something to find for whoever tries.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from regnet_core.data.labels.candidates import CandidateConfig, Candidates, object_candidates
from regnet_core.data.objects.library import ObjectSpec, build_object, library_specs
from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.scenes.standing import stands
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array
from regnet_core.gripper import Gripper

JAW = 0.08
"""The opening that objects are measured for, whatever gripper picks them [m]."""
FILL = 0.9
"""Share of the opening that an object may fill."""
LOWEST = 0.02
"""What is lower than this has too little for the fingers to hold from above [m]."""
EASY_FIT, EASY_SOLIDITY, GRASPABLE = 0.9, 0.8, 0.75
"""Least values of an easy object, and of any object."""

EASY, HARD, ANY, UPRIGHT = "easy", "hard", "any", "upright"
CLASSES = (EASY, HARD, ANY, UPRIGHT)
"""Classes of objects: easy, hard, both as the library has them, and those of both that stand and can be grasped so."""

_TILT = np.cos(np.radians(45.0))
_QUALITY = 0.8
_ENOUGH = 3
"""Grasps of a pose that count as some."""
_CLEARANCE = 0.003
"""Fingertips stay this far above the ground [m]."""
_HAND = Gripper(width=JAW)
_SAMPLES = CandidateConfig(points=200)
_DIRECTIONS = np.stack([np.cos(a := np.linspace(0.0, np.pi, 36, endpoint=False)), np.sin(a)])
"""Horizontal directions (2, 36) along which extents are measured."""
_BATCH = 37
"""Objects of the library that are drawn at a time: one of each family."""
_MOST = 40 * _BATCH
"""When so many objects hold too few of a class, something is wrong."""


class Measures:
    """What is measured on a watertight mesh whose centre of mass is at the origin; shares are in [0, 1].

    Each number is measured when it is first asked for. Grasps are sampled from a fixed seed, so that a mesh always has
    the same measures.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        """Args: the mesh [m]."""
        self._mesh = mesh

    @cached_property
    def solidity(self) -> float:
        """Volume over that of the convex hull."""
        return float(self._mesh.volume / self._mesh.convex_hull.volume)

    @cached_property
    def fit(self) -> float:
        """Share of the resting poses in which the jaw goes across the whole object from above."""
        rotations, share = self._resting
        return float(share @ np.array([_fits(self._mesh.vertices @ rotation.T) for rotation in rotations]))

    @cached_property
    def graspable(self) -> float:
        """Share of the resting poses in which there are good grasps from above."""
        rotations, share = self._resting
        return float(share @ np.array([self._some_from_above(rotation) for rotation in rotations]))

    @cached_property
    def upright(self) -> bool:
        """Whether it stands firmly with its own +z up, and there are good grasps from above as it stands."""
        return stands(self._mesh) and self._some_from_above(np.eye(3))

    @property
    def easy(self) -> bool:
        """Whether it is a compact shape that fits the jaw however it lies."""
        return self.solidity >= EASY_SOLIDITY and self.fit >= EASY_FIT

    def belongs_to(self, kind: str) -> bool:
        """Whether it is of one of the CLASSES."""
        if kind in (EASY, HARD) and self.easy != (kind == EASY):
            return False
        return self.graspable >= GRASPABLE and (kind != UPRIGHT or self.upright)

    @cached_property
    def _resting(self) -> tuple[Array, Array]:
        """Rotations (P, 3, 3) of the resting poses and their probabilities (P,)."""
        poses, probability = trimesh.poses.compute_stable_poses(self._mesh)
        return poses[:, :3, :3], probability / probability.sum()

    @cached_property
    def _grasps(self) -> Candidates:
        found = object_candidates(self._mesh, [_HAND], np.random.default_rng(0), _SAMPLES)[0]
        return found.take(found.score >= _QUALITY)

    def _some_from_above(self, rotation: Array) -> bool:
        """Whether some of the grasps come from above, and stay above the ground, when the object lies turned so."""
        up = rotation[2]
        axes = np.asarray(self._grasps.rotation, np.float64)
        down = -(axes[:, :, 0] @ up)
        half = np.abs(axes[:, :, 1] @ up) * (0.5 * JAW + _HAND.thickness)
        half += np.abs(axes[:, :, 2] @ up) * 0.5 * _HAND.height
        tips = (np.asarray(self._grasps.translation, np.float64) + _HAND.depth * axes[:, :, 0]) @ up
        clear = tips - half >= (self._mesh.vertices @ up).min() + _CLEARANCE
        return bool(np.count_nonzero(clear & (down >= _TILT)) >= _ENOUGH)


@dataclass(frozen=True)
class ObjectSet:
    """How many objects of each class an episode has.

    Attributes:
        name: what tables call it.
        counts: pairs of one of CLASSES and a number.
    """

    name: str
    counts: tuple[tuple[str, int], ...]

    def __post_init__(self) -> None:
        if not self.counts or any(kind not in CLASSES or count < 1 for kind, count in self.counts):
            raise InvalidInputError(
                f"an object set has numbers of at least 1 of {', '.join(CLASSES)} objects, got {self.counts}"
            )

    @property
    def count(self) -> int:
        """Of all objects."""
        return sum(count for _, count in self.counts)


def draw_objects(wanted: ObjectSet, seed: int, episode: int) -> tuple[ObjectModel, ...]:
    """The objects of an episode: those of the first class that come first in a library of its own, and so on.

    Args:
        wanted: how many of which class.
        seed: of the study.
        episode: its number; another one has other objects.

    Raises:
        InvalidInputError: the library does not have as many.
    """
    missing = dict(wanted.counts)
    chosen: dict[str, list[ObjectModel]] = {kind: [] for kind in missing}
    for spec in _endless_library(seed, episode):
        model = build_object(spec)
        measures = Measures(model.mesh)
        kind = next((kind for kind in missing if missing[kind] and measures.belongs_to(kind)), None)
        if kind is None:
            continue
        chosen[kind].append(model)
        missing[kind] -= 1
        if not any(missing.values()):
            return tuple(model for models in chosen.values() for model in models)
    raise InvalidInputError(f"{_MOST} objects of the test split hold too few for '{wanted.name}'; missing: {missing}")


def _endless_library(seed: int, episode: int) -> Iterator[ObjectSpec]:
    """Objects of the test split, families taking turns."""
    own = int(np.random.default_rng([seed, episode]).integers(2**31))
    for start in range(0, _MOST, _BATCH):
        yield from library_specs("test", start + _BATCH, own)[start:]


def _fits(points: Array) -> bool:
    """Whether the jaw goes across all of the points (V, 3) of an object from above."""
    narrowest = np.ptp(points[:, :2] @ _DIRECTIONS, axis=0).min()
    return bool(narrowest <= FILL * JAW and np.ptp(points[:, 2]) >= LOWEST)
