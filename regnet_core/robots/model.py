"""Named robots, and their models with our parallel gripper at the flange.

Frames: the world is that of the scenes (z up, the floor at z = 0). A robot stands at a fixed pose relative to the
middle of the table's top. The flange's z axis points out of the arm; the hand's palm stands on it, so that the grasp
frame (X = approach, Y = closing direction) is

    T_flange_grasp = [X = z_flange, Y = y_flange, Z = -x_flange; origin at (0, 0, mount + palm_depth)]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from regnet_core.errors import ModelError
from regnet_core.geometry import Array, Box
from regnet_core.gripper import Gripper
from regnet_core.robots.assets import robot_file

PREFIX = "robot/"
"""Names of the robot's parts in a world's model begin with this."""


@dataclass(frozen=True)
class Robot:
    """One arm of a robot, and where the robot stands.

    Attributes:
        name: its key in ROBOTS.
        title: for pictures and people.
        file: its model, as `robot_file` takes it.
        base: the body that is placed in the world.
        flange: the body that carries the hand, z out of the arm.
        joints: of the arm, from the base to the flange.
        home: angles of the joints where the arm waits [rad].
        torques: largest torque of each joint's drive [N m].
        speeds: largest speed of each joint in planned motions [rad/s].
        base_position: of the base relative to the middle of the table's top [m].
        mount: from the flange's origin to the back of the palm [m].
        parked: angles of other joints, which never move [rad].
        harmless: pairs of bodies whose collision shapes, convex hulls, overlap though the links are apart.
    """

    name: str
    title: str
    file: str
    base: str
    flange: str
    joints: tuple[str, ...]
    home: tuple[float, ...]
    torques: tuple[float, ...]
    speeds: tuple[float, ...]
    base_position: tuple[float, float, float]
    mount: float = 0.0
    parked: tuple[tuple[str, float], ...] = ()
    harmless: tuple[tuple[str, str], ...] = ()

    def base_in(self, table: Box) -> Array:
        """T_world_base (4, 4) of the robot that stands at a table [m]."""
        lower, upper = np.array(table.lower), np.array(table.upper)
        T = np.eye(4)
        T[:3, 3] = [*(0.5 * (lower + upper))[:2], upper[2]]
        T[:3, 3] += self.base_position
        return T

    def flange_to_grasp(self, gripper: Gripper) -> Array:
        """T_flange_grasp (4, 4) [m]."""
        T = np.eye(4)
        T[:3, :3] = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
        T[2, 3] = self.mount + gripper.palm_depth
        return T


def robot_spec(robot: Robot) -> mujoco.MjSpec:
    """The robot's own model: collision shapes only, the arm's joints only, no drives; its base at the origin.

    Raises:
        ModelError: robosuite is not installed, or its model is another one than expected.
    """
    spec = mujoco.MjSpec.from_file(str(robot_file(robot.file)))
    _remove_what_is_only_seen(spec)
    for item in [*spec.actuators, *spec.cameras, *spec.sites]:
        spec.delete(item)
    _keep_joints(spec, robot)
    for name in (robot.base, robot.flange, *(body for pair in robot.harmless for body in pair)):
        if spec.body(name) is None:
            raise ModelError(f"the model of the robot '{robot.name}' has no body '{name}'")
    spec.body(robot.base).pos = [0.0, 0.0, 0.0]
    for first, second in robot.harmless:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
    return spec


def add_robot(world: mujoco.MjSpec, robot: Robot, T_world_base: Array) -> mujoco.MjsBody:
    """Puts the robot into a world's model, after all that is there; names get PREFIX.

    Returns:
        The body of the flange, weightless as all of the robot: its drives make up for gravity.
    """
    quaternion = Rotation.from_matrix(T_world_base[:3, :3]).as_quat(scalar_first=True)
    frame = world.worldbody.add_frame(pos=T_world_base[:3, 3], quat=quaternion)
    world.attach(robot_spec(robot), prefix=PREFIX, frame=frame)
    return world.body(PREFIX + robot.flange)


def hand_neighbours(robot: Robot, world: mujoco.MjSpec) -> list[str]:
    """Names of the flange's body and of the one that the last joint moves: the hand stands on them."""
    flange = world.body(PREFIX + robot.flange)
    names = [flange.name]
    while not list(flange.joints):
        flange = flange.parent
        names.append(flange.name)
    return names


def get_robot(name: str) -> Robot:
    """The robot of that name.

    Raises:
        ModelError: there is none.
    """
    if name not in ROBOTS:
        raise ModelError(f"no robot '{name}'; there are {', '.join(ROBOTS)}")
    return ROBOTS[name]


def _remove_what_is_only_seen(spec: mujoco.MjSpec) -> None:
    for geom in list(spec.geoms):
        if geom.contype == 0 and geom.conaffinity == 0:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for item in [*(mesh for mesh in spec.meshes if mesh.name not in used), *spec.materials]:
        spec.delete(item)


def _keep_joints(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Freeze every joint but the arm's, at the parked angle."""
    parked = dict(robot.parked)
    missing = set(robot.joints) - {joint.name for joint in spec.joints}
    if missing:
        raise ModelError(f"the model of the robot '{robot.name}' lacks the joints {', '.join(sorted(missing))}")
    for body in spec.bodies:
        for joint in list(body.joints):
            if joint.name in robot.joints:
                continue
            turn = Rotation.from_rotvec(parked.get(joint.name, 0.0) * np.array(joint.axis))
            turned = Rotation.from_quat(body.quat, scalar_first=True) * turn
            body.quat = turned.as_quat(scalar_first=True)
            spec.delete(joint)


_BAXTER_JOINTS = ("s0", "s1", "e0", "e1", "w0", "w1", "w2")
_BAXTER_HOME = (-0.1, -0.636, 0.114, 1.432, 0.735, 1.205, -0.269)
"""Of the right arm [rad]."""
_BAXTER_PARKED = (-0.78, 0.9, 0.0, 0.5, 0.0, 0.0, 0.0)
"""Of the right arm: away from the table, to the side and down [rad]."""
_MIRRORED = (-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
"""The left arm is the right one in a mirror: of its joints, these turn the other way."""


def _baxter(name: str, side: str) -> Robot:
    other = "left" if side == "right" else "right"
    signs = {"right": (1.0,) * 7, "left": _MIRRORED}
    return Robot(
        name=name,
        title=f"Baxter, {side} arm",
        file="baxter/robot.xml",
        base="base",
        flange=f"{side}_hand",
        joints=tuple(f"{side}_{joint}" for joint in _BAXTER_JOINTS),
        home=tuple(sign * angle for sign, angle in zip(signs[side], _BAXTER_HOME, strict=True)),
        # Rethink Robotics, "Hardware specifications": peak torques; three quarters of the speeds in its URDF.
        torques=(50.0, 50.0, 50.0, 50.0, 15.0, 15.0, 15.0),
        speeds=(1.5, 1.5, 1.5, 1.5, 3.0, 3.0, 3.0),
        base_position=(-0.66, 0.2 if side == "right" else -0.2, 0.18),
        parked=tuple(
            (f"{other}_{joint}", sign * angle)
            for joint, sign, angle in zip(_BAXTER_JOINTS, signs[other], _BAXTER_PARKED, strict=True)
        ),
        # The hull of the torso, from the waist to the screen, takes in the space in front of the shoulders.
        harmless=((f"{side}_upper_elbow", "torso"),),
    )


ROBOTS: Mapping[str, Robot] = MappingProxyType(
    {
        robot.name: robot
        for robot in (
            _baxter("baxter", "right"),
            _baxter("baxter_left", "left"),
            Robot(
                name="panda",
                title="Franka Emika Panda",
                file="panda/robot.xml",
                base="base",
                flange="right_hand",
                joints=tuple(f"joint{i}" for i in range(1, 8)),
                home=(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
                # Franka Emika, "Robot and interface specifications": torques; half of the speeds.
                torques=(87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0),
                speeds=(1.05, 1.05, 1.05, 1.05, 1.25, 1.25, 1.25),
                base_position=(-0.5, 0.0, 0.0),
                # The first two are neighbours; the hulls of the others touch when the wrist is folded.
                harmless=(("link0", "link1"), ("link5", "link7")),
            ),
        )
    }
)
"""Every robot by name, of ROBOT_NAMES."""
