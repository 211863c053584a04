"""One attempt at a grasp, phase by phase: approach, close, lift, shake, hold, judge."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from regnet_core.geometry import Array
from regnet_core.grasps import Grasps
from regnet_core.sim.config import SimConfig
from regnet_core.sim.gripper_model import FINGER_STIFFNESS
from regnet_core.sim.motion import Waypoint, line, shake, stay
from regnet_core.sim.outcome import Attempt, Outcome
from regnet_core.sim.physics import LEFT, PART_NAMES, RIGHT, STATIC, HandInScene
from regnet_core.sim.recorder import Recorder

_STILL_RATE = 0.002
"""The fingers have stopped when the opening changes more slowly than this [m/s]."""
_STILL_TIME = 0.05
"""... for as long as this [s]."""
_CLOSING_TIMEOUT = 0.5
"""Longest wait for the fingers to stop, after the time that an empty jaw needs to close [s]."""
_LOST_STRIDE = 10
"""Steps between two looks at whether the hand still touches an object during the lift."""
_LOST_LOOKS = 3
"""The object is lost when so many looks in a row find none: a light grip may lose touch for an instant."""


class Trial:
    """One attempt, from the physics' current state."""

    def __init__(
        self, physics: HandInScene, config: SimConfig, grasp: Grasps, target: int | None, record_every: float | None
    ) -> None:
        """Args: as of `GraspSimulator.attempt`."""
        self._physics = physics
        self._config = config
        self._rotation, self._origin = grasp.rotation[0], grasp.translation[0]
        self._opening = float(grasp.width[0])
        self._target = target
        # Beyond closed, so that a sheet of paper is held with the full force too.
        self._closed = -config.grip_force / FINGER_STIFFNESS
        self._steps = 0
        self._start_poses = physics.object_poses()
        self._planned_poses = self._start_poses
        self._gripped_poses = self._start_poses
        self._shaken_poses = self._start_poses
        self._recorder = None if record_every is None else Recorder(physics, record_every)

    def run(self) -> Attempt:
        """All phases; the first that fails ends the attempt."""
        return self._approach() or self._close() or self._lift() or self._judge()

    def _approach(self) -> Attempt | None:
        start = np.array([-self._config.pre_grasp_distance, 0.0, 0.0])
        self._physics.place_hand(self._rotation, self._origin, start, self._opening)
        collision = self._collision()
        for waypoint in line(start, np.zeros(3), self._config.approach_speed, self._config.timestep):
            if collision is not None:
                break
            self._step(waypoint, self._opening)
            collision = self._collision()
        return collision

    def _collision(self) -> Attempt | None:
        """The end of the attempt when the hand touches something hard, or an object is no longer where it was."""
        left = max(0.0, -float(self._physics.hand_position()[0]))
        touches = self._physics.touches()
        if touches.force.sum() > self._config.contact_force:
            hardest = int(touches.force.argmax())
            owner = int(touches.owner[hardest])
            what = "the table or a fixture" if owner == STATIC else f"object {owner}"
            force = f" with {touches.force.sum():.0f} N" if self._steps else ""  # that of an overlap has no meaning
            return self._end(
                Outcome.COLLISION,
                f"{PART_NAMES[touches.part[hardest]]} touched {what}{force}, {left:.3f} m before the grasp",
            )
        if not self._physics.any_object_awake():
            return None
        moved, turned = _displacement(self._start_poses, self._physics.object_poses())
        pushed = (moved > self._config.push_distance) | (turned > self._config.push_angle)
        if not pushed.any():
            return None
        k = int(pushed.argmax())
        return self._end(
            Outcome.COLLISION,
            f"object {k} was pushed by {moved[k]:.3f} m and {turned[k]:.2f} rad, {left:.3f} m before the grasp",
        )

    def _close(self) -> Attempt | None:
        """Closes until the fingers stop; fails when one of them then touches no object."""
        self._planned_poses = self._poses_in_hand()
        self._close_until_still()
        self._gripped_poses = self._poses_in_hand()
        left, right = (self._touched_by(side) for side in (LEFT, RIGHT))
        if left and right:
            return None
        which = PART_NAMES[RIGHT if left else LEFT] if left or right else "each finger"
        return self._end(Outcome.MISSED, f"{which} touches no object after closing to {self._physics.opening():.3f} m")

    def _close_until_still(self) -> None:
        dt, rate = self._config.timestep, self._config.closing_speed
        standing = Waypoint(np.zeros(3), np.zeros(3))
        steps = math.ceil((self._opening - self._closed) / (rate * dt))
        for i in range(1, steps + 1):
            self._step(standing, max(self._closed, self._opening - i * rate * dt), -rate)
        still = 0.0
        for _ in range(round(_CLOSING_TIMEOUT / dt)):
            self._step(standing, self._closed)
            still = still + dt if abs(self._physics.opening_rate()) < _STILL_RATE else 0.0
            if still >= _STILL_TIME:
                return

    def _lift(self) -> Attempt | None:
        """Lifts, shakes and holds still; ends early once the hand has lost all objects."""
        c = self._config
        up = self._rotation.T @ np.array([0.0, 0.0, c.lift_height])
        lost = self._carry(line(np.zeros(3), up, c.lift_speed, c.timestep))
        lost = lost or self._carry(shake(up, c.shake_amplitude, c.shake_period, c.timestep))
        self._shaken_poses = self._poses_in_hand()
        return lost or self._carry(stay(up, c.hold_time, c.timestep))

    def _carry(self, way: Iterable[Waypoint]) -> Attempt | None:
        empty = 0
        for i, waypoint in enumerate(way):
            self._step(waypoint, self._closed)
            if i % _LOST_STRIDE:
                continue
            empty = 0 if self._touches_object() else empty + 1
            if empty == _LOST_LOOKS:
                height = float(self._rotation[2] @ self._physics.hand_position())
                return self._end(Outcome.SLIPPED, f"the hand lost what it held {height:.3f} m above the grasp")
        return None

    def _judge(self) -> Attempt:
        lifted = self._lifted()
        if not lifted:
            return self._end(Outcome.SLIPPED, "no object was lifted, though each finger touched one")
        if len(lifted) > 1:
            return self._end(Outcome.SEVERAL, f"objects {list(lifted)} were lifted together", lifted)
        k = lifted[0]
        poses = self._poses_in_hand()
        slip = float(_displacement(self._gripped_poses, poses)[0][k])
        turn = float(_displacement(self._planned_poses, poses)[1][k])
        if not (k in self._touched_by(LEFT) and k in self._touched_by(RIGHT)):
            return self._end(Outcome.SLIPPED, f"object {k} was lifted, but is not between both fingers", lifted)
        creep = float(_displacement(self._shaken_poses, poses)[0][k])
        if creep > self._config.creep_distance:
            return self._end(
                Outcome.SLIPPED, f"object {k} still moves in the hand, by {creep:.4f} m while held", lifted, slip, turn
            )
        if self._target is not None and k != self._target:
            wrong = f"object {k} is held instead of object {self._target}"
            return self._end(Outcome.WRONG_OBJECT, wrong, lifted, slip, turn)
        held = f"object {k} is held; it moved by {slip:.4f} m and turned by {turn:.2f} rad in the hand"
        return self._end(Outcome.HELD, held, lifted, slip, turn)

    def _touched_by(self, side: int) -> set[int]:
        """The objects that a finger presses on."""
        touches = self._physics.touches()
        return set(touches.owner[(touches.part == side) & (touches.force > 0.0)].tolist()) - {STATIC}

    def _touches_object(self) -> bool:
        return bool((self._physics.touches().owner != STATIC).any())

    def _lifted(self) -> tuple[int, ...]:
        rise = self._physics.object_heights() - self._start_poses[:, 2, 3]
        return tuple(int(k) for k in np.flatnonzero(rise >= 0.5 * self._config.lift_height))

    def _poses_in_hand(self) -> Array:
        """(K, 4, 4) T_hand_object."""
        return np.linalg.inv(self._physics.hand_pose()) @ self._physics.object_poses()

    def _step(self, waypoint: Waypoint, opening: float, opening_rate: float = 0.0) -> None:
        self._physics.step(waypoint, opening, opening_rate)
        self._steps += 1
        if self._recorder is not None:
            self._recorder.after_step()

    def _end(
        self,
        outcome: Outcome,
        message: str,
        lifted: tuple[int, ...] = (),
        slip: float = math.nan,
        turn: float = math.nan,
    ) -> Attempt:
        return Attempt(
            outcome=outcome,
            lifted=lifted,
            opening=self._physics.opening(),
            slip=slip,
            turn=turn,
            duration=self._steps * self._config.timestep,
            message=message,
            recording=None if self._recorder is None else self._recorder.recording(),
        )


def _displacement(before: Array, after: Array) -> tuple[Array, Array]:
    """How far the origins moved (K,) [m] and the frames turned (K,) [rad] between poses (K, 4, 4)."""
    moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    if not len(before):
        return moved, np.zeros(0)
    turn = Rotation.from_matrix(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
    return moved, turn.magnitude()
