"""Random sampling: the ``random`` baseline of the REGNet V2 paper, the measure of what checking collision alone gives.

Seen surface points are drawn at random. The approach is about the inward normal, the roll about it and the depth are
random, and the jaw is open at W. As in the paper's code, a hand needs some points between its fingers. Nothing is
known about the contacts: quality is a random number, so that the ranking is random as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from regnet_core.checks import check_range
from regnet_core.collision import SceneCollision
from regnet_core.geometry import Mask, normalised
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.proposer import Proposals
from regnet_core.scene import Scene


@dataclass(frozen=True)
class RandomConfig:
    """How many grasps, and how they are drawn.

    Raises:
        InvalidInputError: a number is out of range.
    """

    samples: int = 4000
    """Hands that are drawn; at most so many are proposed."""
    normal_cone: float = 0.2
    """Standard deviation of the approach about the inward normal, in each of two directions [rad]."""
    shallowest: float = 0.010
    """Least depth of the fingertips beyond the surface point [m]."""
    min_points: int = 10
    """Seen points of the objects that must lie between the fingers."""

    def __post_init__(self) -> None:
        check_range("samples", self.samples, 1, 10_000_000)
        check_range("normal_cone", self.normal_cone, 0.0, 1.0, "rad")
        check_range("shallowest", self.shallowest, 0.0, 0.2, "m")
        check_range("min_points", self.min_points, 0, 10**9)


class RandomSampler:
    """The ``random`` model."""

    name = "random"

    def __init__(self, config: RandomConfig | None = None) -> None:
        self.config = config or RandomConfig()

    def propose(self, scene: Scene, gripper: Gripper, focus: Mask | None, rng: np.random.Generator) -> Proposals:
        """Draw hands at the focused surface points that the camera saw."""
        seeds = np.flatnonzero(scene.wanted(focus) & scene.objects.observed)
        if len(seeds) == 0:
            return Proposals(Grasps.empty(), 0)
        hands = self._hands(scene, rng.choice(seeds, self.config.samples), gripper, rng)
        seen = scene.objects.points[scene.objects.observed]
        between = SceneCollision(seen, None).occupancy(hands, gripper).closing
        return Proposals(hands[between >= self.config.min_points], len(hands))

    def _hands(self, scene: Scene, seeds: np.ndarray, gripper: Gripper, rng: np.random.Generator) -> Grasps:
        cfg, m = self.config, len(seeds)
        approach = normalised(cfg.normal_cone * rng.normal(size=(m, 3)) - scene.objects.normals[seeds])
        # Perpendicular to the approach and to a direction without preference: any roll is as likely as another.
        closing = normalised(np.cross(approach, rng.normal(size=(m, 3))))
        rotation = np.stack([approach, closing, np.cross(approach, closing)], axis=-1)
        depth = rng.uniform(min(cfg.shallowest, gripper.depth), gripper.depth, m)
        translation = scene.objects.points[seeds] - (gripper.depth - depth)[:, None] * approach
        return Grasps.from_poses(rotation, translation, np.full(m, gripper.width), rng.random(m))
