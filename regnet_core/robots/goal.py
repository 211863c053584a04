"""What a robot is asked to do."""

from __future__ import annotations

from dataclasses import dataclass

from regnet_core.geometry import Array


@dataclass(frozen=True, eq=False)
class GraspGoal:
    """A grasp to execute, in the world frame.

    Attributes:
        pre_grasp, grasp, lift: (4, 4) poses of the grasp frame [m]; the hand goes straight from one to the next.
        opening: of the jaw before closing [m].
    """

    pre_grasp: Array
    grasp: Array
    lift: Array
    opening: float
