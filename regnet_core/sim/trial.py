"""One attempt at a grasp, phase by phase: approach, close, lift, shake, hold, judge."""

from __future__ import annotations

import math

import numpy as np

from regnet_core.grasps import Grasps
from regnet_core.sim.config import SimConfig
from regnet_core.sim.grasp_motion import GraspMotion, displacement
from regnet_core.sim.motion import line, shake, stay
from regnet_core.sim.outcome import Attempt, Outcome
from regnet_core.sim.physics import LEFT, PART_NAMES, RIGHT, HandInScene


class Trial:
    """One attempt, from the physics' current state."""

    def __init__(
        self, physics: HandInScene, config: SimConfig, grasp: Grasps, target: int | None, record_every: float | None
    ) -> None:
        """Args: as of `GraspSimulator.attempt`."""
        self._motion = GraspMotion(physics, config, grasp, record_every)
        self._config = config
        self._target = target
        self._planned_poses = self._gripped_poses = self._shaken_poses = self._motion.start_poses

    def run(self) -> Attempt:
        """All phases; the first that fails ends the attempt."""
        return self._approach() or self._close() or self._lift() or self._judge()

    def _approach(self) -> Attempt | None:
        """The end of the attempt when the hand touches something hard, or an object is no longer where it was."""
        for _ in self._motion.approach():
            collision = self._motion.collision()
            if collision is not None:
                return self._end(Outcome.COLLISION, collision)
        return None

    def _close(self) -> Attempt | None:
        """Closes until the fingers stop; fails when one of them then touches no object."""
        self._planned_poses = self._motion.poses_in_hand()
        self._motion.close()
        self._gripped_poses = self._motion.poses_in_hand()
        left, right = (self._motion.touched_by(side) for side in (LEFT, RIGHT))
        if left and right:
            return None
        which = PART_NAMES[RIGHT if left else LEFT] if left or right else "each finger"
        opening = self._motion.physics.opening()
        return self._end(Outcome.MISSED, f"{which} touches no object after closing to {opening:.3f} m")

    def _lift(self) -> Attempt | None:
        """Lifts, shakes and holds still; ends early once the hand has lost all objects."""
        c, motion = self._config, self._motion
        up = motion.rotation.T @ np.array([0.0, 0.0, c.lift_height])
        held = motion.carry(line(np.zeros(3), up, c.lift_speed, c.timestep))
        held = held and motion.carry(shake(up, c.shake_amplitude, c.shake_period, c.timestep))
        self._shaken_poses = motion.poses_in_hand()
        if held and motion.carry(stay(up, c.hold_time, c.timestep)):
            return None
        return self._end(Outcome.SLIPPED, f"the hand lost what it held {motion.height():.3f} m above the grasp")

    def _judge(self) -> Attempt:
        motion = self._motion
        lifted = motion.risen(0.5 * self._config.lift_height)
        if not lifted:
            return self._end(Outcome.SLIPPED, "no object was lifted, though each finger touched one")
        if len(lifted) > 1:
            return self._end(Outcome.SEVERAL, f"objects {list(lifted)} were lifted together", lifted)
        k = lifted[0]
        poses = motion.poses_in_hand()
        slip = float(displacement(self._gripped_poses, poses)[0][k])
        turn = float(displacement(self._planned_poses, poses)[1][k])
        if not (k in motion.touched_by(LEFT) and k in motion.touched_by(RIGHT)):
            return self._end(Outcome.SLIPPED, f"object {k} was lifted, but is not between both fingers", lifted)
        creep = float(displacement(self._shaken_poses, poses)[0][k])
        if creep > self._config.creep_distance:
            return self._end(
                Outcome.SLIPPED, f"object {k} still moves in the hand, by {creep:.4f} m while held", lifted, slip, turn
            )
        if self._target is not None and k != self._target:
            wrong = f"object {k} is held instead of object {self._target}"
            return self._end(Outcome.WRONG_OBJECT, wrong, lifted, slip, turn)
        held = f"object {k} is held; it moved by {slip:.4f} m and turned by {turn:.2f} rad in the hand"
        return self._end(Outcome.HELD, held, lifted, slip, turn)

    def _end(
        self,
        outcome: Outcome,
        message: str,
        lifted: tuple[int, ...] = (),
        slip: float = math.nan,
        turn: float = math.nan,
    ) -> Attempt:
        motion = self._motion
        return Attempt(
            outcome=outcome,
            lifted=lifted,
            opening=motion.physics.opening(),
            slip=slip,
            turn=turn,
            duration=motion.time,
            message=message,
            recording=motion.recording(),
        )
