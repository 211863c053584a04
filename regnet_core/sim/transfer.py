"""Pick and place: approach, close, lift, carry to a place, lower, release. What came of it is told, and not judged."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from regnet_core.checks import check_range
from regnet_core.geometry import Array
from regnet_core.grasps import Grasps
from regnet_core.sim.config import SimConfig
from regnet_core.sim.grasp_motion import GraspMotion
from regnet_core.sim.motion import Waypoint, line, stay
from regnet_core.sim.outcome import Recording
from regnet_core.sim.physics import LEFT, RIGHT, HandInScene

MOMENTS = ("before", "at the grasp", "closed", "lifted", "above the place", "released")
"""Of a transfer, in their order; one that ends early has the first few, and one of the following."""
GIVEN_UP, LOST = "given up", "lost"
"""The approach ends against a resistance; the hand has lost all that it held."""


@dataclass(frozen=True)
class TransferConfig:
    """How a grasped object is brought away.

    Attributes:
        stop_force: an approach against more than this is given up, as robots do that guard themselves [N].
        lift_height: how far the hand is lifted straight up [m].
        lift_speed: mean speed of the lift [m/s].
        carry_speed: mean speed of the level way to the place [m/s].
        lower_height: how far the hand is lowered over the place [m].
        lower_speed: mean speed of that [m/s].
        release_time: how long the open hand then stands still [s].

    Raises:
        InvalidInputError: a number is out of range.
    """

    stop_force: float = 20.0
    lift_height: float = 0.35
    lift_speed: float = 0.3
    carry_speed: float = 0.5
    lower_height: float = 0.15
    lower_speed: float = 0.3
    release_time: float = 0.4

    def __post_init__(self) -> None:
        for name, (low, high, unit) in _RANGES.items():
            check_range(name, getattr(self, name), low, high, unit)


_RANGES = {
    "stop_force": (0.1, 1000.0, "N"),
    "lift_height": (0.02, 2.0, "m"),
    "lift_speed": (0.01, 2.0, "m/s"),
    "carry_speed": (0.01, 2.0, "m/s"),
    "lower_height": (0.0, 2.0, "m"),
    "lower_speed": (0.01, 2.0, "m/s"),
    "release_time": (0.0, 10.0, "s"),
}


@dataclass(frozen=True, eq=False)
class TransferRecord:
    """What happened in a transfer."""

    contact: str | None
    """What the hand touched hard, or pushed, before it closed, in a sentence; None: nothing."""
    stopped: bool
    """Whether the approach was given up."""
    gripped: tuple[tuple[int, ...], tuple[int, ...]]
    """The objects that the fingers at +Y and at -Y press on after closing."""
    blocked: bool
    """Whether a finger presses on the table or a fixture after closing."""
    opening: float
    """Distance between the finger pads after closing [m]; NaN when the hand did not come to that."""
    lifted: tuple[int, ...]
    """Indices of the objects that are, at the end of the lift, at least half of its height above where they were."""
    lost: str | None
    """Where the hand lost all that it held, before it was to release it; None: it did not."""
    duration: float
    """Simulated time [s]."""
    moments: Mapping[str, float]
    """When each of the MOMENTS that there were was reached, and when it was given up or all was lost [s]."""
    recording: Recording | None = field(default=None, repr=False)
    """Present when it was asked for."""


class Transfer:
    """One pick and place, from the physics' current state."""

    def __init__(
        self,
        physics: HandInScene,
        config: SimConfig,
        transfer: TransferConfig,
        grasp: Grasps,
        way: Array,
        record_every: float | None,
    ) -> None:
        """Args: as of `GraspSimulator.transfer`, and the level way (2,) from the grasp to the place [m]."""
        self._motion = GraspMotion(physics, config, grasp, record_every)
        self._config = transfer
        self._timestep = config.timestep
        self._way = way
        self._position: Array = np.zeros(3)
        self._contact: str | None = None
        self._stopped = False
        self._gripped: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())
        self._blocked = False
        self._opening = math.nan
        self._lifted: tuple[int, ...] = ()
        self._lost: str | None = None
        self._moments: dict[str, float] = {}

    def run(self) -> TransferRecord:
        """All phases, as far as it comes."""
        if self._approach() and self._close() and self._lift() and self._carry() and self._lower():
            self._release()
        motion = self._motion
        return TransferRecord(
            contact=self._contact,
            stopped=self._stopped,
            gripped=self._gripped,
            blocked=self._blocked,
            opening=self._opening,
            lifted=self._lifted,
            lost=self._lost,
            duration=motion.time,
            moments=self._moments,
            recording=motion.recording(),
        )

    def _reached(self, moment: str) -> None:
        self._moments[moment] = self._motion.time

    def _approach(self) -> bool:
        """False when the hand meets more resistance than it should, or starts in something."""
        motion = self._motion
        for _ in motion.approach():
            self._contact = self._contact or motion.collision()
            if not self._moments:
                self._reached("before")
            force = float(motion.physics.touches().force.sum())
            if force > self._config.stop_force:
                self._stopped = True
                self._reached(GIVEN_UP)
                self._contact = motion.collision() or self._contact
                return False
        self._reached("at the grasp")
        return True

    def _close(self) -> bool:
        """False when nothing is between the fingers."""
        motion = self._motion
        motion.close()
        left, right = (tuple(sorted(motion.touched_by(side))) for side in (LEFT, RIGHT))
        self._gripped, self._opening = (left, right), motion.physics.opening()
        self._blocked = motion.touches_static()
        self._reached("closed")
        return bool(left or right)

    def _lift(self) -> bool:
        height = self._config.lift_height
        carried = self._move([0.0, 0.0, height], self._config.lift_speed)
        self._lifted = self._motion.risen(0.5 * height)
        if not carried:
            return self._lose(f"{self._motion.height():.3f} m above the grasp")
        self._reached("lifted")
        return True

    def _carry(self) -> bool:
        way = np.append(self._way, 0.0)
        if not self._move(way, self._config.carry_speed):
            done = float(np.linalg.norm((self._motion.rotation @ self._motion.physics.hand_position())[:2]))
            left = max(0.0, float(np.linalg.norm(way)) - done)
            return self._lose(f"on the way to the place, {left:.3f} m before it")
        self._reached("above the place")
        return True

    def _lower(self) -> bool:
        if not self._move([0.0, 0.0, -self._config.lower_height], self._config.lower_speed):
            return self._lose("above the place, while it was lowered")
        return True

    def _lose(self, where: str) -> bool:
        self._lost = where
        self._reached(LOST)
        return False

    def _move(self, way: npt.ArrayLike, speed: float) -> bool:
        """Along a straight way (3,) in the world [m]; False once all objects are lost."""
        motion = self._motion
        end = self._position + motion.rotation.T @ np.asarray(way)
        start, self._position = self._position, end
        return motion.carry(line(start, end, speed, self._timestep))

    def _release(self) -> None:
        """Opens as wide as before the grasp, and waits."""
        motion, rate = self._motion, self._motion.config.closing_speed
        here = Waypoint(self._position, np.zeros(3))
        opening = motion.physics.opening()
        steps = math.ceil(max(0.0, motion.wanted_opening - opening) / (rate * self._timestep))
        for i in range(1, steps + 1):
            motion.step(here, min(motion.wanted_opening, opening + i * rate * self._timestep), rate)
        for waypoint in stay(self._position, self._config.release_time, self._timestep):
            motion.step(waypoint, motion.wanted_opening)
        self._reached("released")
