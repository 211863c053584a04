"""What every attempt is made of: the hand comes straight along the approach, closes, and carries what it holds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from regnet_core.geometry import Array
from regnet_core.grasps import Grasps
from regnet_core.sim.config import SimConfig
from regnet_core.sim.gripper_model import FINGER_STIFFNESS
from regnet_core.sim.motion import Waypoint, line
from regnet_core.sim.outcome import Recording
from regnet_core.sim.physics import PART_NAMES, STATIC, HandInScene
from regnet_core.sim.recorder import Recorder

_STILL_RATE = 0.002
"""The fingers have stopped when the opening changes more slowly than this [m/s]."""
_STILL_TIME = 0.05
"""... for as long as this [s]."""
_CLOSING_TIMEOUT = 0.5
"""Longest wait for the fingers to stop, after the time that an empty jaw needs to close [s]."""
_LOST_STRIDE = 10
"""Steps between two looks at whether the hand still touches an object while it carries."""
_LOST_LOOKS = 3
"""The object is lost when so many looks in a row find none: a light grip may lose touch for an instant."""


class GraspMotion:
    """One grasp, from the physics' current state; who uses it decides what follows from what happens."""

    def __init__(self, physics: HandInScene, config: SimConfig, grasp: Grasps, record_every: float | None) -> None:
        """Args: as of `GraspSimulator.attempt`."""
        self.physics = physics
        self.config = config
        self.rotation, self.origin = grasp.rotation[0], grasp.translation[0]
        self.wanted_opening = float(grasp.width[0])
        # Beyond closed, so that a sheet of paper is held with the full force too.
        self.closed = -config.grip_force / FINGER_STIFFNESS
        self.steps = 0
        self.start_poses = physics.object_poses()
        self._recorder = None if record_every is None else Recorder(physics, record_every)

    @property
    def time(self) -> float:
        """Since the attempt began [s]."""
        return self.steps * self.config.timestep

    def recording(self) -> Recording | None:
        """What was recorded so far."""
        return None if self._recorder is None else self._recorder.recording()

    def approach(self) -> Iterator[None]:
        """Puts the hand before the grasp and moves it there; gives way at the start and after each step."""
        start = np.array([-self.config.pre_grasp_distance, 0.0, 0.0])
        self.physics.place_hand(self.rotation, self.origin, start, self.wanted_opening)
        yield
        for waypoint in line(start, np.zeros(3), self.config.approach_speed, self.config.timestep):
            self.step(waypoint, self.wanted_opening)
            yield

    def collision(self) -> str | None:
        """What the hand touches hard, or which object is no longer where it was, in a sentence; None: neither."""
        left = max(0.0, -float(self.physics.hand_position()[0]))
        touches = self.physics.touches()
        force = touches.force.sum()
        if force > self.config.contact_force:
            hardest = int(touches.force.argmax())
            owner = int(touches.owner[hardest])
            what = "the table or a fixture" if owner == STATIC else f"object {owner}"
            how = f" with {force:.0f} N" if self.steps else ""  # that of an overlap has no meaning
            return f"{PART_NAMES[touches.part[hardest]]} touched {what}{how}, {left:.3f} m before the grasp"
        if not self.physics.any_object_awake():
            return None
        moved, turned = displacement(self.start_poses, self.physics.object_poses())
        pushed = (moved > self.config.push_distance) | (turned > self.config.push_angle)
        if not pushed.any():
            return None
        k = int(pushed.argmax())
        return f"object {k} was pushed by {moved[k]:.3f} m and {turned[k]:.2f} rad, {left:.3f} m before the grasp"

    def close(self) -> None:
        """Closes until the fingers stop."""
        dt, rate = self.config.timestep, self.config.closing_speed
        standing = Waypoint(np.zeros(3), np.zeros(3))
        steps = math.ceil((self.wanted_opening - self.closed) / (rate * dt))
        for i in range(1, steps + 1):
            self.step(standing, max(self.closed, self.wanted_opening - i * rate * dt), -rate)
        still = 0.0
        for _ in range(round(_CLOSING_TIMEOUT / dt)):
            self.step(standing, self.closed)
            still = still + dt if abs(self.physics.opening_rate()) < _STILL_RATE else 0.0
            if still >= _STILL_TIME:
                return

    def carry(self, way: Iterable[Waypoint]) -> bool:
        """Moves the closed hand; stops and gives False once it has lost all objects."""
        empty = 0
        for i, waypoint in enumerate(way):
            self.step(waypoint, self.closed)
            if i % _LOST_STRIDE:
                continue
            empty = 0 if self.touches_object() else empty + 1
            if empty == _LOST_LOOKS:
                return False
        return True

    def height(self) -> float:
        """How far above the grasp the hand is [m]."""
        return float(self.rotation[2] @ self.physics.hand_position())

    def risen(self, by: float) -> tuple[int, ...]:
        """The objects that are at least so far above where they were [m]."""
        rise = self.physics.object_heights() - self.start_poses[:, 2, 3]
        return tuple(int(k) for k in np.flatnonzero(rise >= by))

    def touched_by(self, side: int) -> set[int]:
        """The objects that a finger presses on."""
        touches = self.physics.touches()
        return set(touches.owner[(touches.part == side) & (touches.force > 0.0)].tolist()) - {STATIC}

    def touches_object(self) -> bool:
        """Whether any part of the hand is in contact with an object."""
        return bool((self.physics.touches().owner != STATIC).any())

    def touches_static(self) -> bool:
        """Whether a part of the hand presses on the table or a fixture."""
        touches = self.physics.touches()
        return bool(((touches.owner == STATIC) & (touches.force > 0.0)).any())

    def poses_in_hand(self) -> Array:
        """(K, 4, 4) T_hand_object."""
        return np.linalg.inv(self.physics.hand_pose()) @ self.physics.object_poses()

    def step(self, waypoint: Waypoint, opening: float, opening_rate: float = 0.0) -> None:
        """One timestep."""
        self.physics.step(waypoint, opening, opening_rate)
        self.steps += 1
        if self._recorder is not None:
            self._recorder.after_step()


def displacement(before: Array, after: Array) -> tuple[Array, Array]:
    """How far the origins moved (K,) [m] and the frames turned (K,) [rad] between poses (K, 4, 4)."""
    moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    if not len(before):
        return moved, np.zeros(0)
    turn = Rotation.from_matrix(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
    return moved, turn.magnitude()
