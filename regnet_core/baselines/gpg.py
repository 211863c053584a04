"""Grasp candidates as Grasp Pose Detection samples them: ten Pas, Gualtieri, Saenko and Platt, "Grasp Pose Detection
in Point Clouds", 2017; the sampler of PointNetGPD (Liang et al., 2019) as well.

Points are drawn on the seen surface. At each, the local frame of the surface (darboux.py) gives an approach against
the normal and a closing direction along which the surface bends most, both turned about the axis of least curvature by
several angles. Each hand is placed and pushed forward (finger_placement.py), and kept when something is between its
fingers and it hits nothing.

As the REGNet V2 paper states it, 1000 surface points are drawn and 100 hands are kept. With 8 angles at each point
there are many more; they are looked at in random order until there are enough, so that they are spread over the scene.
What a hand must not hit is judged as ``GraspDetector`` judges any method's grasps, hidden sides included.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from regnet_core.baselines.darboux import LocalFrames, local_frames
from regnet_core.baselines.finger_placement import place_fingers
from regnet_core.checks import check_range
from regnet_core.collision import SceneCollision
from regnet_core.geometry import Array, Mask
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.ops.voxel_grid import VoxelGrid, build_grid
from regnet_core.pointcloud import random_sample
from regnet_core.scene import Scene

_AT_ONCE = 512
"""Hands that are placed in one go."""
_CELL = 0.012
"""Edge length of the cells of the points to be hit [m]."""


@dataclass(frozen=True)
class GpgConfig:
    """How candidates are sampled. What the REGNet V2 paper does not state is as in the published code of GPD.

    Raises:
        InvalidInputError: a number is out of range.
    """

    points: int = 1000
    """Surface points."""
    angles: int = 8
    """Orientations about the axis of least curvature, evenly spaced over 180 degrees."""
    places: int = 10
    """Places along the closing axis that are tried."""
    neighbourhood: float = 0.01
    """Radius of the neighbourhoods that local frames are computed from [m]."""
    least_reach: float = 0.01
    """How far beyond the surface point the fingertips must get [m]; "init_bite" in the published code."""
    grasps: int = 100
    """So many hands that hit nothing are enough."""
    min_points: int = 1
    """Seen points of objects that must lie between the fingers."""

    def __post_init__(self) -> None:
        for name in ("points", "angles", "places", "grasps"):
            check_range(name, getattr(self, name), 1, 10_000_000)
        check_range("neighbourhood", self.neighbourhood, 1e-4, 0.2, "m")
        check_range("least_reach", self.least_reach, 0.0, 0.2, "m")
        check_range("min_points", self.min_points, 0, 10**9)


class Candidates(NamedTuple):
    """G hands that hit nothing, the jaw open at W, in the scene's frame."""

    rotation: Array
    """(G, 3, 3): columns approach, closing direction, their cross product."""
    translation: Array
    """(G, 3): grasp centres c [m]."""
    tried: int
    """How many hands were looked at."""


class GpgSampler:
    """Samples candidates in prepared scenes."""

    def __init__(self, config: GpgConfig | None = None) -> None:
        self.config = config or GpgConfig()

    def sample(self, scene: Scene, gripper: Gripper, focus: Mask | None, rng: np.random.Generator) -> Candidates:
        """Sample at seen points that are in focus.

        Args:
            scene: the prepared cloud.
            gripper: the hand.
            focus: (S,) the points of ``scene.objects`` to sample at; None: all of them.
            rng: source of randomness; the same state gives the same candidates.
        """
        cfg, surface = self.config, scene.objects
        seeds = np.flatnonzero(scene.wanted(focus) & surface.observed)
        seeds = seeds[random_sample(len(seeds), cfg.points, rng)]
        seen = surface.points[surface.observed]
        near = build_grid(seen, cfg.neighbourhood)
        frames = local_frames(
            near, surface.normals[surface.observed][near.order], surface.points[seeds], cfg.neighbourhood
        )
        search = _Search(
            cfg,
            gripper,
            scene,
            build_grid(np.concatenate([seen, scene.structure]), _CELL),
            SceneCollision(scene.obstacles, scene.plane),
            SceneCollision(seen, None),
        )
        order = rng.permutation(len(seeds) * cfg.angles)
        parts, tried, kept = [], 0, 0
        for start in range(0, len(order), _AT_ONCE):
            some = order[start : start + _AT_ONCE]
            rotation, at = hand_frames(frames, cfg.angles, some), surface.points[seeds[some // cfg.angles]]
            hands = search.free(rotation, at)
            parts.append(hands)
            tried, kept = tried + len(some), kept + len(hands)
            if kept >= cfg.grasps:
                break
        found = Grasps.concatenate(parts)[: cfg.grasps]
        return Candidates(found.rotation, found.translation, tried)


def hand_frames(frames: LocalFrames, angles: int, which: np.ndarray) -> Array:
    """Rotations (C, 3, 3) of hands: number ``i * angles + j`` is the one at point i turned by the j-th angle.

    At the angle 0 a hand approaches against the normal and closes along the binormal; angles start at -90 degrees.
    """
    point, number = which // angles, which % angles
    turn = (np.pi * (number / angles - 0.5))[:, None]
    normal, binormal = frames.normal[point], frames.binormal[point]
    approach = np.sin(turn) * binormal - np.cos(turn) * normal
    closing = np.cos(turn) * binormal + np.sin(turn) * normal
    return np.stack([approach, closing, np.cross(approach, closing)], axis=-1)


class _Search(NamedTuple):
    """Tries hands in one scene."""

    config: GpgConfig
    gripper: Gripper
    scene: Scene
    seen: VoxelGrid
    everything: SceneCollision
    objects: SceneCollision

    def free(self, rotation: Array, at: Array) -> Grasps:
        """The hands with rotations (C, 3, 3) at surface points (C, 3) that find a place and hit nothing there."""
        cfg, gripper = self.config, self.gripper
        limits = self.everything.config
        placed = place_fingers(
            rotation, at, gripper, self.seen, self.scene.plane, places=cfg.places, least_reach=cfg.least_reach,
            margin=limits.margin, clearance=limits.table_clearance,
        )  # fmt: skip
        good = placed.found
        rotation, at = rotation[good], at[good]
        translation = at + placed.offset[good, None] * rotation[:, :, 1]
        translation = translation + (placed.reach[good, None] - gripper.depth) * rotation[:, :, 0]
        count = len(rotation)
        hands = Grasps.from_poses(rotation, translation, np.full(count, gripper.width), np.zeros(count))
        keep = ~(self.everything.with_table(hands, gripper) | self.everything.with_points(hands, gripper))
        if cfg.min_points > 0:
            keep &= self.objects.occupancy(hands, gripper).closing >= cfg.min_points
        return hands[keep]
