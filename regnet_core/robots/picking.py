"""One pick, phase by phase: pre-grasp, approach, close, lift, place, return."""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from regnet_core.geometry import Array
from regnet_core.robots.cell_physics import ARM, PART_NAMES, STATIC, CellPhysics
from regnet_core.robots.drive import Drive, path_length
from regnet_core.robots.planning import Plan

_LOST_LOOKS = 3
"""An object is lost when so many looks in a row find no contact: a light grip may lose touch for an instant."""


class Phase(enum.Enum):
    """What the robot is doing."""

    PRE_GRASP = "pre_grasp"
    APPROACH = "approach"
    CLOSE = "close"
    LIFT = "lift"
    PLACE = "place"
    RETURN = "return"


DONE_BEFORE = {
    Phase.PRE_GRASP: 0.0,
    Phase.APPROACH: 0.3,
    Phase.CLOSE: 0.45,
    Phase.LIFT: 0.5,
    Phase.PLACE: 0.65,
    Phase.RETURN: 0.9,
}
"""How much of a pick is done when a phase begins, about."""


class PickOutcome(enum.Enum):
    """How a pick ended; only PLACED is a success."""

    PLACED = "placed"
    """The object rests in the bin to place into."""
    UNREACHABLE = "unreachable"
    """There is no way for the arm; it did not move."""
    COLLISION = "collision"
    """Before closing, hand or arm pressed on something."""
    MISSED = "missed"
    """After closing, at least one finger touches no object."""
    DROPPED = "dropped"
    """The object was lost on the way, or fell beside the bin."""
    CANCELLED = "cancelled"
    """Whoever watches asked for it: the arm stopped, let go of what it held, and went home."""


Watch = Callable[[Phase, float], bool]
"""Called with the phase and how much of the pick is done, from 0 to 1; false: cancel."""


class PickStopped(Exception):  # noqa: N818 (a turn of events, not an error)
    """The pick ends here, without success."""

    def __init__(self, outcome: PickOutcome, message: str) -> None:
        super().__init__(message)
        self.outcome, self.message = outcome, message


class Placed(NamedTuple):
    """What a pick that went well has done."""

    item: int
    """Index of the object."""
    rise: float
    """How far it was lifted [m]."""


class Pick:
    """One pick along a plan."""

    def __init__(self, drive: Drive, names: Sequence[str], watch: Watch, stop_force: float) -> None:
        """Make it ready.

        Args:
            drive: of the arm, which is where the plan begins.
            names: of the objects, for messages.
            watch: is told about the phases, and may cancel before the object is let go.
            stop_force: hand or arm stop when they press with more than this before closing [N].
        """
        self._drive, self._physics = drive, drive.physics
        self._names, self._watch, self._stop_force = names, watch, stop_force

    def run(self, plan: Plan, line_ends: Callable[[Array], Array], opening: float, open_jaw: float) -> Placed:
        """All phases but the return.

        Args:
            plan: the configurations.
            line_ends: position (3,) of the hand at a configuration, for the speed on lines.
            opening: of the jaw before closing [m].
            open_jaw: its opening when it lets go [m].

        Raises:
            PickStopped: a phase failed, or the watch cancelled; the arm is where it stopped.
        """
        drive = self._drive
        drive.start()
        drive.set_opening(opening)
        self._begin(Phase.PRE_GRASP)
        drive.follow(plan.reach, self._stop_at_contact, lambda: self._look(Phase.PRE_GRASP))
        self._line(plan.approach, Phase.APPROACH, line_ends, self._stop_at_contact)
        self._begin(Phase.CLOSE)
        held = self._close()
        height = self._height(held)
        keeps = _Grip(self._physics, held).check
        self._line(plan.lift, Phase.LIFT, line_ends, keeps)
        rise = self._height(held) - height
        self._begin(Phase.PLACE)
        drive.follow(plan.carry, keeps, lambda: self._look(Phase.PLACE))
        drive.dwell()
        drive.set_opening(open_jaw)
        drive.wait_for_rest()
        return Placed(held, rise)

    def _line(
        self, path: Sequence[Array], phase: Phase, line_ends: Callable[[Array], Array], guard: Callable[[], None]
    ) -> None:
        self._begin(phase)
        length = path_length(line_ends(q) for q in (path[0], path[-1]))
        self._drive.follow_line(path, length, guard, lambda: self._look(phase))

    def _begin(self, phase: Phase) -> None:
        self._look(phase)

    def _look(self, phase: Phase) -> None:
        if not self._watch(phase, DONE_BEFORE[phase]):
            raise PickStopped(PickOutcome.CANCELLED, f"cancelled in the phase {phase.value}")

    def _stop_at_contact(self) -> None:
        touches = self._physics.touches()
        if touches.force.sum() <= self._stop_force:
            return
        hardest = int(touches.force.argmax())
        owner = int(touches.owner[hardest])
        what = self._names[owner] if owner >= 0 else "the table or a bin" if owner == STATIC else "the robot itself"
        part, force = PART_NAMES[touches.part[hardest]], touches.force.sum()
        raise PickStopped(PickOutcome.COLLISION, f"{part} pressed on {what} with {force:.0f} N")

    def _close(self) -> int:
        held = self._drive.close()
        if not held:
            opening = max(0.0, self._physics.opening())
            raise PickStopped(PickOutcome.MISSED, f"the jaw closed to {opening:.3f} m and holds nothing")
        return held[0]

    def _height(self, index: int) -> float:
        return float(self._physics.object_poses()[index, 2, 3])


class _Grip:
    """Looks after what the hand holds."""

    def __init__(self, physics: CellPhysics, held: int) -> None:
        self._physics, self._held = physics, held
        self._empty = 0

    def check(self) -> None:
        """Raise PickStopped once the object is lost."""
        touches = self._physics.touches()
        there = bool(np.any((touches.owner == self._held) & (touches.part != ARM)))
        self._empty = 0 if there else self._empty + 1
        if self._empty >= _LOST_LOOKS:
            height = self._physics.hand_pose()[2, 3]
            raise PickStopped(PickOutcome.DROPPED, f"the hand lost what it held, {height:.2f} m above the floor")
