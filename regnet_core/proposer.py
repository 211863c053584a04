"""The one interface between GraspDetector and a method that proposes grasps."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from regnet_core.geometry import Mask
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.scene import Scene


class Proposals(NamedTuple):
    """What a method proposes, before collision, filters and ranking."""

    grasps: Grasps
    """In the scene's frame, each no wider than the gripper's W."""
    considered: int
    """How many candidates the method looked at, the proposed ones included."""


class Proposer(Protocol):
    """A grasp detection method."""

    name: str
    """The model name that ``GraspDetector`` reports."""

    def propose(self, scene: Scene, gripper: Gripper, focus: Mask | None, rng: np.random.Generator) -> Proposals:
        """Propose grasps of ``scene.objects`` for this gripper.

        Args:
            scene: the prepared cloud.
            gripper: the hand.
            focus: (S,) the points of ``scene.objects`` that the user wants grasped; None: all of them.
            rng: source of randomness.
        """
        ...
