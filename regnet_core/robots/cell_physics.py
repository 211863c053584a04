"""The physics of a work cell: a robot with our hand, a table, bins and objects in one MuJoCo model."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from regnet_core.data.scenes.scene import Scene
from regnet_core.geometry import Array
from regnet_core.gripper import Gripper
from regnet_core.robots.model import PREFIX, Robot, add_robot, hand_neighbours
from regnet_core.robots.motion import Setpoint
from regnet_core.sim.config import SimConfig
from regnet_core.sim.gripper_model import FINGER_STIFFNESS, finger_damping, jaw_index, mount_gripper
from regnet_core.sim.world import world_spec

STATIC = -1
"""Owner of the table and of fixtures."""
ROBOT = -2
"""Owner of the robot's other parts."""
PALM, LEFT, RIGHT, ARM = 0, 1, 2, 3
PART_NAMES = ("the palm", "the finger at +Y", "the finger at -Y", "the arm")
STIFFNESS_PER_TORQUE = 80.0
"""Stiffness of a joint's drive for each newton metre of its largest torque [1/rad]."""


class Touches(NamedTuple):
    """C contacts of the robot with something else."""

    part: NDArray[np.int64]
    """(C,) PALM, LEFT, RIGHT or ARM."""
    owner: NDArray[np.int64]
    """(C,) index of the object, STATIC or ROBOT."""
    force: Array
    """(C,) along the contact's normal [N]."""


class CellPhysics:
    """State and steps of a cell."""

    def __init__(self, scene: Scene, robot: Robot, gripper: Gripper, config: SimConfig) -> None:
        """Builds the model, the robot at home with the jaw open; takes some hundredths of a second."""
        self.count = len(scene.objects)
        self.timestep = config.timestep
        self.robot = robot
        self.model = _model(scene, robot, gripper, config)
        self.data = mujoco.MjData(self.model)
        self._jaw = jaw_index(self.model)
        joints = [self.model.joint(PREFIX + name) for name in robot.joints]
        self._qpos = np.array([int(joint.qposadr[0]) for joint in joints])
        self._qvel = np.array([int(joint.dofadr[0]) for joint in joints])
        drives = [self.model.actuator(PREFIX + name).id for name in robot.joints]
        self._ctrl = np.array(drives)
        # The drives damp the whole velocity; what they should not damp is added to the position they aim at.
        self._lag = self.model.actuator_biasprm[drives, 2] / self.model.actuator_biasprm[drives, 1]
        self._jaw_lag = finger_damping() / FINGER_STIFFNESS
        self._owner = self._owners()
        self._part = self._parts()
        self.data.qpos[: 7 * self.count] = _as_qpos(scene.poses)
        self.data.qpos[self._qpos] = robot.home
        self.data.qpos[self._jaw.qpos] = 0.5 * gripper.width
        self.data.ctrl[self._ctrl] = robot.home
        self.data.ctrl[self._jaw.ctrl] = gripper.width
        mujoco.mj_forward(self.model, self.data)

    def step(self, aim: Setpoint, opening: float, opening_rate: float = 0.0) -> None:
        """One timestep with the drives aiming at a setpoint and an opening [m] that changes at a rate [m/s]."""
        self.data.ctrl[self._ctrl] = aim.q + self._lag * aim.velocity
        self.data.ctrl[self._jaw.ctrl] = opening + self._jaw_lag * opening_rate
        mujoco.mj_step(self.model, self.data)

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self.data.time)

    def q(self) -> Array:
        """(n,) angles of the joints [rad]."""
        return self.data.qpos[self._qpos].copy()

    def opening(self) -> float:
        """Distance between the finger pads [m]."""
        return float(self.data.qpos[self._jaw.qpos].sum())

    def opening_rate(self) -> float:
        """[m/s], negative while the hand closes."""
        return float(self.data.qvel[self._jaw.qvel].sum())

    def hand_pose(self) -> Array:
        """(4, 4) T_world_hand: the grasp frame as the hand carries it."""
        pose = np.eye(4)
        pose[:3, :3] = self.data.xmat[self._jaw.body].reshape(3, 3)
        pose[:3, 3] = self.data.xpos[self._jaw.body]
        return pose

    def object_poses(self) -> Array:
        """(K, 4, 4) T_world_object."""
        poses = np.tile(np.eye(4), (self.count, 1, 1))
        q = self.data.qpos[: 7 * self.count].reshape(-1, 7)
        poses[:, :3, 3] = q[:, :3]
        if self.count:
            poses[:, :3, :3] = Rotation.from_quat(q[:, 3:], scalar_first=True).as_matrix()
        return poses

    def place_objects(self, poses: Array) -> None:
        """Puts the objects at rest at poses (K, 4, 4)."""
        self.data.qpos[: 7 * self.count] = _as_qpos(poses)
        self.data.qvel[: 6 * self.count] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def object_speeds(self) -> Array:
        """(K,) the larger of the linear speed [m/s] and the angular speed times 0.1 m."""
        v = self.data.qvel[: 6 * self.count].reshape(-1, 6)
        return np.maximum(np.linalg.norm(v[:, :3], axis=1), 0.1 * np.linalg.norm(v[:, 3:], axis=1))

    def touches(self) -> Touches:
        """The contacts of hand and arm in the last step."""
        geom = self.data.contact.geom  # (n, 2)
        part = self._part[geom]
        row, side = np.nonzero(part >= 0)
        other = geom[row, 1 - side]
        address = self.data.contact.efc_address[row]
        force = np.where(address >= 0, self.data.efc_force[address], 0.0) if len(row) else np.zeros(0)
        return Touches(part[row, side], self._owner[other], force)

    def _owners(self) -> NDArray[np.int64]:
        body = self.model.geom_bodyid.astype(np.int64)
        # Body 0 is the world, then come the objects, then the robot.
        return np.where(body == 0, STATIC, np.where(body <= self.count, body - 1, ROBOT))

    def _parts(self) -> NDArray[np.int64]:
        part = np.full(self.model.ngeom, -1, dtype=np.int64)
        moving = self.model.body_weldid[self.model.geom_bodyid] != 0
        part[(self._owner == ROBOT) & moving] = ARM
        part[[self._jaw.palm, self._jaw.left, self._jaw.right]] = PALM, LEFT, RIGHT
        return part


def _model(scene: Scene, robot: Robot, gripper: Gripper, config: SimConfig) -> mujoco.MjModel:
    spec = world_spec(scene.objects, scene.table, scene.fixtures, config.timestep)
    spec.option.impratio = config.impratio
    flange = add_robot(spec, robot, robot.base_in(scene.table))
    hand = mount_gripper(spec, flange, robot.flange_to_grasp(gripper), gripper, config)
    for body in (hand, *hand.bodies):
        for name in hand_neighbours(robot, spec):
            spec.add_exclude(bodyname1=body.name, bodyname2=name)
    for name, torque in zip(robot.joints, robot.torques, strict=True):
        drive = spec.add_actuator(
            name=PREFIX + name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=PREFIX + name,
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            forcerange=[-torque, torque],
        )
        drive.set_to_position(kp=STIFFNESS_PER_TORQUE * torque, dampratio=1.0)
    return spec.compile()


def _as_qpos(poses: Array) -> Array:
    """(7 K,) of free bodies at poses (K, 4, 4)."""
    if not len(poses):
        return np.zeros(0)
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    return np.concatenate([poses[:, :3, 3], quaternions], axis=1).ravel()
