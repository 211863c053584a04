"""What came of a simulated grasp."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

from regnet_core.geometry import Array


class Outcome(enum.Enum):
    """How an attempt ended; only HELD is a success."""

    HELD = "held"
    """Exactly one object, the wanted one, is lifted and at rest between both fingers."""
    COLLISION = "collision"
    """Before closing, the hand touched something with notable force or pushed an object away."""
    MISSED = "missed"
    """After closing, at least one finger touches no object."""
    SLIPPED = "slipped"
    """Something was between the fingers, and was lost, or is still slipping, after the lift."""
    WRONG_OBJECT = "wrong object"
    """Exactly one object is held, and it is not the target."""
    SEVERAL = "several"
    """More than one object was lifted."""


@dataclass(frozen=True, eq=False)
class Recording:
    """The scene and the hand at F instants of an attempt, in the world frame."""

    time: Array
    """(F,) since the attempt began [s]."""
    object_poses: Array
    """(F, K, 4, 4) T_world_object."""
    hand_poses: Array
    """(F, 4, 4) T_world_hand: the grasp frame as the hand carries it."""
    opening: Array
    """(F,) distance between the finger pads [m]."""


@dataclass(frozen=True, eq=False)
class Attempt:
    """The result of one attempt."""

    outcome: Outcome
    lifted: tuple[int, ...]
    """Indices of the objects that are, at the end, at least half of the lift height above where they were.

    Empty when the attempt ended early; what the hand lost may still be falling then.
    """
    opening: float
    """Distance between the finger pads at the end [m]."""
    slip: float
    """How far the held object moved in the hand between the end of closing and the end [m]; NaN when none is held."""
    turn: float
    """By how much the held object turned in the hand, from before closing to the end [rad]; NaN when none is held.

    A thin object that is gripped askew turns until it is flush with the pads: it is held, but not as was planned.
    """
    duration: float
    """Simulated time [s]."""
    message: str
    """One sentence for people: what happened, to which object, with what number."""
    recording: Recording | None = field(default=None, repr=False)
    """Present when it was asked for."""

    @property
    def success(self) -> bool:
        """Whether the outcome is HELD."""
        return self.outcome is Outcome.HELD
