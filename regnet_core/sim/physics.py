"""A scene and a gripper in one MuJoCo model: its state, one step of it, and who touches whom."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from regnet_core.data.scenes.scene import Scene
from regnet_core.geometry import Array
from regnet_core.gripper import Gripper
from regnet_core.sim.config import SimConfig
from regnet_core.sim.gripper_model import (
    BASE_STIFFNESS,
    FINGER_STIFFNESS,
    add_gripper,
    base_damping,
    finger_damping,
    hand_index,
)
from regnet_core.sim.motion import Waypoint
from regnet_core.sim.world import world_spec

PALM, LEFT, RIGHT = 0, 1, 2
PART_NAMES = ("the palm", "the finger at +Y", "the finger at -Y")
STATIC = -1
_PARKED = np.array([0.0, 0.0, 100.0])
"""Where the hand waits between attempts, and around which removed objects are kept [m]."""
_AWAKE = -11
"""Value of MuJoCo's tree_asleep for a tree that has just been woken: -(1 + mjMINAWAKE)."""
_NUDGE = 1e-12
"""Any force wakes a body, even one that does not move it [N, N m]."""


class Touches(NamedTuple):
    """C contacts of the hand."""

    part: NDArray[np.int64]
    """(C,) PALM, LEFT or RIGHT."""
    owner: NDArray[np.int64]
    """(C,) index of the object, or STATIC for the table and fixtures."""
    geom: NDArray[np.int64]
    """(C,) the geom that is touched."""
    force: Array
    """(C,) along the contact's normal [N]."""


class HandInScene:
    """The physics of a scene's objects and one gripper.

    Objects that nothing disturbs sleep: they are kept in place exactly, at no cost, until an awake body touches them
    or one that they rest on.
    """

    def __init__(self, scene: Scene, gripper: Gripper, config: SimConfig) -> None:
        self.count = len(scene.objects)
        self.timestep = config.timestep
        spec = world_spec(scene.objects, scene.table, scene.fixtures, config.timestep)
        spec.option.impratio = config.impratio
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        for model, pose in zip(scene.objects, scene.poses, strict=True):
            body = spec.body(model.name)
            body.pos = pose[:3, 3]
            body.quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
            body.sleep = mujoco.mjtSleepPolicy.mjSLEEP_INIT
        add_gripper(spec, gripper, config)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._hand = hand_index(self.model)
        self._lag = np.array([base_damping() / BASE_STIFFNESS] * 3 + [finger_damping() / FINGER_STIFFNESS])
        body_of = self.model.geom_bodyid.astype(np.int64)
        self._owner = np.where(body_of <= self.count, body_of - 1, STATIC)  # body 0 is the world
        self._part = np.full(self.model.ngeom, -1, dtype=np.int64)
        self._part[[self._hand.palm, self._hand.left, self._hand.right]] = PALM, LEFT, RIGHT
        self._given = scene.poses
        self.reset()

    def reset(self) -> None:
        """The scene as it was given, at rest, and no hand in it."""
        self.restart(self._given)

    def restart(self, poses: Array, removed: Collection[int] = ()) -> None:
        """All objects at rest at these poses (K, 4, 4), no hand, and some of the objects out of the scene.

        What follows depends on nothing that was before.
        """
        self.model.qpos0[: 7 * self.count] = _as_qpos(poses).ravel()
        self.model.body_gravcomp[1 : self.count + 1] = 0.0
        for index in removed:
            self.model.body_gravcomp[index + 1] = 1.0
            self.model.qpos0[7 * index : 7 * index + 3] = _away(index)
        # The reset puts objects to sleep unless they touch the hand, so that goes first.
        self._set_frame(np.eye(3), _PARKED)
        mujoco.mj_resetData(self.model, self.data)
        self.park_hand()

    def park_hand(self) -> None:
        """Takes the hand out of the scene."""
        self.place_hand(np.eye(3), _PARKED, np.zeros(3), 0.0)

    def place_hand(self, rotation: Array, origin: Array, position: Array, opening: float) -> None:
        """Puts the hand at rest at a position (3,) in the frame of a grasp, and computes its contacts."""
        hand = self._hand
        self._set_frame(rotation, origin)
        self.data.qpos[hand.qpos] = [*position, 0.5 * opening, 0.5 * opening]
        self.data.qvel[hand.qvel] = 0.0
        self.data.ctrl[hand.ctrl] = [*position, opening]
        self._stay_awake(self.data.tree_asleep < 0)
        mujoco.mj_forward(self.model, self.data)

    def _set_frame(self, rotation: Array, origin: Array) -> None:
        self.model.body_pos[self._hand.body] = origin
        self.model.body_quat[self._hand.body] = Rotation.from_matrix(rotation).as_quat(scalar_first=True)

    def step(self, hand: Waypoint, opening: float, opening_rate: float = 0.0) -> None:
        """One timestep with the hand's drives aiming at a waypoint and an opening [m] that changes at a rate [m/s].

        No object falls asleep: one that leans on the hand is slow too, and would hang in the air when the hand leaves.
        """
        self._stay_awake(self.data.tree_asleep < 0)
        # The drives damp the whole velocity; what they should not damp is added to the position they aim at.
        aim = np.append(hand.position, opening) + self._lag * np.append(hand.velocity, opening_rate)
        self.data.ctrl[self._hand.ctrl] = aim
        mujoco.mj_step(self.model, self.data)

    def step_without_hand(self) -> None:
        """One timestep in which the hand is parked; objects at rest fall asleep."""
        mujoco.mj_step(self.model, self.data)

    def remove(self, index: int) -> None:
        """Takes an object out of the scene: it floats, far away and weightless, until the next reset."""
        self.model.body_gravcomp[index + 1] = 1.0
        self.data.qpos[7 * index : 7 * index + 3] = _away(index)
        self.data.qvel[6 * index : 6 * index + 6] = 0.0
        self._wake()

    def _wake(self) -> None:
        """Wakes all objects: what slept on a body that is gone would go on sleeping in the air."""
        self.data.xfrc_applied[1 : self.count + 1] = _NUDGE
        mujoco.mj_forward(self.model, self.data)
        self.data.xfrc_applied[1 : self.count + 1] = 0.0
        self._stay_awake(np.ones(self.model.ntree, dtype=bool))

    def _stay_awake(self, trees: NDArray[np.bool_]) -> None:
        """Lets these awake trees, the objects and the hand, be slow for a while before they fall asleep."""
        self.data.tree_asleep[trees] = _AWAKE

    def object_poses(self) -> Array:
        """(K, 4, 4) T_world_object."""
        poses = np.tile(np.eye(4), (self.count, 1, 1))
        q = self.data.qpos[: 7 * self.count].reshape(-1, 7)
        poses[:, :3, 3] = q[:, :3]
        if self.count:
            poses[:, :3, :3] = Rotation.from_quat(q[:, 3:], scalar_first=True).as_matrix()
        return poses

    def any_object_awake(self) -> bool:
        """Whether any object may have moved in the last step."""
        return bool((self.data.tree_asleep[: self.count] < 0).any())

    def object_heights(self) -> Array:
        """(K,) of the centres of mass above z = 0 [m]."""
        return self.data.qpos[: 7 * self.count].reshape(-1, 7)[:, 2].copy()

    def object_speeds(self) -> Array:
        """(K,) the larger of the linear speed [m/s] and the angular speed times 0.1 m."""
        v = self.data.qvel[: 6 * self.count].reshape(-1, 6)
        return np.maximum(np.linalg.norm(v[:, :3], axis=1), 0.1 * np.linalg.norm(v[:, 3:], axis=1))

    def hand_position(self) -> Array:
        """(3,) in the frame of the grasp [m]."""
        return self.data.qpos[self._hand.qpos][:3].copy()

    def hand_pose(self) -> Array:
        """(4, 4) T_world_hand."""
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(self.model.body_quat[self._hand.body], scalar_first=True).as_matrix()
        pose[:3, 3] = self.model.body_pos[self._hand.body] + pose[:3, :3] @ self.hand_position()
        return pose

    def opening(self) -> float:
        """Distance between the finger pads [m]."""
        return float(self.data.qpos[self._hand.qpos][3:].sum())

    def opening_rate(self) -> float:
        """[m/s], negative while the hand closes."""
        return float(self.data.qvel[self._hand.qvel][3:].sum())

    def touches(self) -> Touches:
        """The contacts of the hand in the last step."""
        geom = self.data.contact.geom  # (n, 2)
        part = self._part[geom]
        row, side = np.nonzero(part >= 0)
        other = geom[row, 1 - side].astype(np.int64)
        address = self.data.contact.efc_address[row]
        # With elliptic cones, the first of a contact's constraint forces is the one along its normal.
        force = np.where(address >= 0, self.data.efc_force[address], 0.0) if len(row) else np.zeros(0)
        return Touches(part[row, side], self._owner[other], other, force)


def _as_qpos(poses: Array) -> Array:
    """Positions and quaternions (K, 7), scalar first, of poses (K, 4, 4)."""
    if not len(poses):
        return np.zeros((0, 7))
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)])


def _away(index: int) -> Array:
    """Where a removed object is kept (3,) [m]."""
    return _PARKED + np.array([10.0 + index, 0.0, 0.0])
