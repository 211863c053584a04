"""Moves the arm and the jaw of a cell's robot, in simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from regnet_core.geometry import Array
from regnet_core.robots.cell_physics import LEFT, RIGHT, CellPhysics
from regnet_core.robots.motion import Setpoint, timed
from regnet_core.sim.config import SimConfig
from regnet_core.sim.gripper_model import FINGER_STIFFNESS

LOOK_PERIOD = 0.05
"""Simulated time between two looks of whoever watches [s]."""
_STILL_RATE, _STILL_TIME = 0.002, 0.05
"""The fingers have stopped when the opening changes more slowly than this for so long [m/s, s]."""
_CLOSING_TIMEOUT = 0.5
"""Longest wait for the fingers to stop, after the time that an empty jaw needs to close [s]."""
_DWELL = 0.1
"""Arm or jaw stand still for so long at the end of a line, and after the jaw was moved [s]."""
_REST_SPEED, _REST_TIME, _REST_LONGEST = 0.01, 0.1, 3.0
"""Objects are at rest when they are slower than this for so long; no wait is longer [m/s, s, s]."""


def _nothing() -> None:
    """Nobody looks."""


class Drive:
    """Where the arm and the jaw are to be, and how the arm came there."""

    def __init__(self, physics: CellPhysics, home: Array, opening: float, config: SimConfig) -> None:
        """Args: the physics, with the arm at home (n,) [rad] and the jaw open [m]; speeds and force of the hand."""
        self.physics, self._config = physics, config
        self._speeds = np.array(physics.robot.speeds)
        self._aim = Setpoint(home, np.zeros_like(home))
        self._opening = opening
        # Beyond closed, so that a sheet of paper is held with the full force too.
        self._closed = -config.grip_force / FINGER_STIFFNESS
        self._way_here = [home]

    @property
    def q(self) -> Array:
        """(n,) where the arm is to be [rad]."""
        return self._aim.q

    def start(self) -> None:
        """From here on the way is remembered."""
        self._way_here = [self.q]

    def follow(
        self,
        path: Sequence[Array],
        each_step: Callable[[], None] = _nothing,
        each_look: Callable[[], None] = _nothing,
        least: float = 0.0,
    ) -> None:
        """Along a path, from rest to rest.

        Args:
            path: (n,) configurations, the first of them where the arm is [rad].
            each_step: called after every step of the physics; what it raises ends the motion.
            each_look: called every LOOK_PERIOD; what it raises ends the motion.
            least: least duration [s].
        """
        stride = max(1, round(LOOK_PERIOD / self.physics.timestep))
        for i, aim in enumerate(timed(path, self._speeds, self.physics.timestep, least)):
            self._step(aim)
            each_step()
            if (i + 1) % stride == 0:
                self._way_here.append(aim.q)
                each_look()
        self._way_here.append(self.q)

    def follow_line(
        self, path: Sequence[Array], length: float, each_step: Callable[[], None], each_look: Callable[[], None]
    ) -> None:
        """Along a straight line of the hand, of so many metres, at the speed of approaches, and a moment at its end."""
        self.follow(path, each_step, each_look, least=length / self._config.approach_speed)
        self.dwell()

    def go_back(self) -> None:
        """The way the arm came since `start`, backwards."""
        for aim in timed(self._way_here[::-1], self._speeds, self.physics.timestep):
            self._step(aim)
        self._way_here = [self.q]

    def set_opening(self, opening: float) -> None:
        """Opens or closes the jaw, with nothing in it, at the closing speed; opening in [m]."""
        start, way = self._opening, opening - self._opening
        steps = math.ceil(abs(way) / (self._config.closing_speed * self.physics.timestep))
        for i in range(1, steps + 1):
            self._opening = start + i / steps * way
            self.physics.step(self._still, self._opening)
        self.dwell()

    def close(self) -> tuple[int, ...]:
        """Closes the jaw until the fingers stop; indices of the objects that both of them press on."""
        rate, dt = self._config.closing_speed, self.physics.timestep
        start = self._opening
        for i in range(1, math.ceil((start - self._closed) / (rate * dt)) + 1):
            self._opening = max(self._closed, start - i * rate * dt)
            self.physics.step(self._still, self._opening, -rate)
        still = 0.0
        for _ in range(round(_CLOSING_TIMEOUT / dt)):
            self.physics.step(self._still, self._opening)
            still = still + dt if abs(self.physics.opening_rate()) < _STILL_RATE else 0.0
            if still >= _STILL_TIME:
                break
        touches = self.physics.touches()
        pressed = [
            set(touches.owner[(touches.part == side) & (touches.force > 0.0)].tolist()) for side in (LEFT, RIGHT)
        ]
        return tuple(sorted(k for k in pressed[0] & pressed[1] if k >= 0))

    def dwell(self, seconds: float = _DWELL) -> None:
        """Stand still."""
        for _ in range(round(seconds / self.physics.timestep)):
            self.physics.step(self._still, self._opening)

    def wait_for_rest(self) -> None:
        """Stand still until all objects are at rest, or for the longest time."""
        dt, still = self.physics.timestep, 0.0
        for _ in range(round(_REST_LONGEST / dt)):
            self.physics.step(self._still, self._opening)
            still = still + dt if bool((self.physics.object_speeds() < _REST_SPEED).all()) else 0.0
            if still >= _REST_TIME:
                return

    @property
    def _still(self) -> Setpoint:
        return Setpoint(self._aim.q, np.zeros_like(self._aim.q))

    def _step(self, aim: Setpoint) -> None:
        self._aim = aim
        self.physics.step(aim, self._opening)


def path_length(positions: Iterable[Array]) -> float:
    """Of a polygon through positions (3,) [m]."""
    points = np.array(list(positions))
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
