"""A parallel gripper, added to a MuJoCo model: free-floating, or on a body such as the flange of a robot.

The free hand stands in the grasp frame: its body's frame is the frame of the grasp that is tried, and three slide
joints move it along the grasp's X, Y and Z. Its orientation never changes during an attempt, so the hand needs no
rotational joints, and its frame is set in the compiled model before each attempt. Both fingers are driven by one motor:
a joint equality keeps the opening symmetric, as the mechanism of such a gripper does, and a tendon over both joints
carries the force.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from regnet_core.geometry import Array, Box
from regnet_core.gripper import Gripper
from regnet_core.sim.config import SimConfig
from regnet_core.sim.world import contact_options

PALM_MASS = 1.0
"""[kg]"""
FINGER_MASS = 0.1
"""Of each finger [kg]."""
BASE_STIFFNESS = 20000.0
"""Of the drive of the hand along each axis [N/m]."""
BASE_FORCE = 150.0
"""The drive's largest force along each axis [N]."""
FINGER_STIFFNESS = 5000.0
"""Of the drive of the opening [N/m]."""
PALM_FRICTION = 0.5
"""Sliding friction coefficient, of hard plastic."""
_ROLLING = 0.0001
"""Rolling friction as a length [m]."""

_NAME = "__gripper__"  # no object of a scene is called so
_AXES = "xyz"


class JawIndex(NamedTuple):
    """Where palm and fingers are in a compiled model."""

    body: int
    """The hand's body, whose frame is the grasp frame."""
    qpos: slice
    """Distances of both pads from the middle (2,) [m]."""
    qvel: slice
    """The same for velocities [m/s]."""
    ctrl: int
    """Command of the opening [m]."""
    palm: int
    """Geom of the palm."""
    left: int
    """Geom of the finger at +Y."""
    right: int
    """Geom of the finger at -Y."""


class HandIndex(NamedTuple):
    """Where the free hand is in a compiled model."""

    body: int
    """Its body, whose pose is the frame of the grasp."""
    qpos: slice
    """Position of the hand in that frame (3,), then the distances of both pads from the middle (2,) [m]."""
    qvel: slice
    """The same for velocities [m/s]."""
    ctrl: slice
    """Commands: position (3,), then the opening (1,) [m]."""
    palm: int
    """Geom of the palm."""
    left: int
    """Geom of the finger at +Y."""
    right: int
    """Geom of the finger at -Y."""


def base_damping() -> float:
    """The damping of the hand's drive, critical [N s/m]."""
    return 2.0 * math.sqrt(BASE_STIFFNESS * (PALM_MASS + 2.0 * FINGER_MASS))


def finger_damping() -> float:
    """The damping of the opening's drive, critical: a change of the opening moves each finger by half of it [N s/m]."""
    return 2.0 * math.sqrt(FINGER_STIFFNESS * 0.5 * FINGER_MASS)


def add_gripper(spec: mujoco.MjSpec, gripper: Gripper, config: SimConfig) -> None:
    """Adds the free hand and its drives to a model, after the objects."""
    hand = spec.worldbody.add_body(name=_NAME, gravcomp=1.0)
    for i, axis in enumerate(_AXES):
        hand.add_joint(name=f"{_NAME}/{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=np.eye(3)[i])
    _add_base_drives(spec)
    _add_jaw(spec, hand, gripper, config)


def mount_gripper(
    spec: mujoco.MjSpec, parent: mujoco.MjsBody, T_parent_grasp: Array, gripper: Gripper, config: SimConfig
) -> mujoco.MjsBody:
    """Adds the hand, rigidly, to a body of a model, and the drive of its opening.

    Args:
        spec: the model.
        parent: the body that carries the hand, such as a robot's flange.
        T_parent_grasp: (4, 4) the grasp frame in the frame of that body.
        gripper: its dimensions.
        config: force of the fingers, friction and softness of the pads.

    Returns:
        The hand's body, whose frame is the grasp frame.
    """
    quaternion = Rotation.from_matrix(T_parent_grasp[:3, :3]).as_quat(scalar_first=True)
    hand = parent.add_body(name=_NAME, pos=T_parent_grasp[:3, 3], quat=quaternion, gravcomp=1.0)
    _add_jaw(spec, hand, gripper, config)
    return hand


def _add_jaw(spec: mujoco.MjSpec, hand: mujoco.MjsBody, gripper: Gripper, config: SimConfig) -> None:
    """Palm and fingers on the hand's body, and the drive of the opening."""
    bodies = gripper.bodies(gripper.width)
    contact = contact_options(config.timestep)
    palm = _add_box(hand, "palm", bodies.palm, PALM_MASS, contact)
    palm.friction = [PALM_FRICTION, 0.005, _ROLLING]
    for name, box, side in (("left", bodies.left_finger, 1.0), ("right", bodies.right_finger, -1.0)):
        # The finger's frame is at the pad of the closed hand, so that its joint reads the distance from the middle.
        finger = hand.add_body(name=f"{_NAME}/{name}", gravcomp=1.0)
        finger.add_joint(
            name=f"{_NAME}/{name}",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=[0.0, side, 0.0],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            range=[0.0, 0.5 * gripper.width + 1e-4],
            solref_limit=contact["solref"],
            solimp_limit=contact["solimp"],
        )
        pad = _add_box(finger, name, _moved(box, -side * 0.5 * gripper.width), FINGER_MASS, contact)
        pad.friction = [config.pad_friction, config.pad_torsion, _ROLLING]
        pad.priority = 1  # the pad's friction and softness count, not the larger friction and the mean softness
        pad.solref = [config.pad_time, 1.0]
    spec.add_exclude(bodyname1=f"{_NAME}/left", bodyname2=f"{_NAME}/right")
    _couple_fingers(spec, contact)
    _add_opening_drive(spec, config.grip_force)


def hand_index(model: mujoco.MjModel) -> HandIndex:
    """Where `add_gripper` put the hand."""
    first, last = model.joint(f"{_NAME}/x"), model.joint(f"{_NAME}/right")
    geoms = (model.geom(f"{_NAME}/{name}").id for name in ("palm", "left", "right"))
    ctrl = model.actuator(f"{_NAME}/x").id
    return HandIndex(
        model.body(_NAME).id,
        slice(int(first.qposadr[0]), int(last.qposadr[0]) + 1),
        slice(int(first.dofadr[0]), int(last.dofadr[0]) + 1),
        slice(ctrl, ctrl + 4),
        *geoms,
    )


def jaw_index(model: mujoco.MjModel) -> JawIndex:
    """Where `add_gripper` or `mount_gripper` put palm and fingers."""
    left, right = model.joint(f"{_NAME}/left"), model.joint(f"{_NAME}/right")
    geoms = (model.geom(f"{_NAME}/{name}").id for name in ("palm", "left", "right"))
    return JawIndex(
        model.body(_NAME).id,
        slice(int(left.qposadr[0]), int(right.qposadr[0]) + 1),
        slice(int(left.dofadr[0]), int(right.dofadr[0]) + 1),
        model.actuator(f"{_NAME}/opening").id,
        *geoms,
    )


def _add_box(body: mujoco.MjsBody, name: str, box: Box, mass: float, contact: dict[str, object]) -> mujoco.MjsGeom:
    lower, upper = np.array(box.lower), np.array(box.upper)
    size = upper - lower
    body.mass = mass
    body.ipos = 0.5 * (lower + upper)
    body.inertia = mass / 12.0 * (np.sum(size**2) - size**2)
    body.explicitinertial = True
    return body.add_geom(
        name=f"{_NAME}/{name}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=0.5 * (lower + upper), size=0.5 * size, **contact
    )


def _moved(box: Box, along_y: float) -> Box:
    (x0, y0, z0), (x1, y1, z1) = box.lower, box.upper
    return Box((x0, y0 + along_y, z0), (x1, y1 + along_y, z1))


def _couple_fingers(spec: mujoco.MjSpec, contact: dict[str, object]) -> None:
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT,
        name1=f"{_NAME}/left",
        name2=f"{_NAME}/right",
        data=[0.0, 1.0, *[0.0] * (mujoco.mjNEQDATA - 2)],
        solref=contact["solref"],
        solimp=contact["solimp"],
    )


def _add_base_drives(spec: mujoco.MjSpec) -> None:
    for axis in _AXES:
        drive = spec.add_actuator(
            name=f"{_NAME}/{axis}",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=f"{_NAME}/{axis}",
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            forcerange=[-BASE_FORCE, BASE_FORCE],
        )
        drive.set_to_position(kp=BASE_STIFFNESS, kv=base_damping())


def _add_opening_drive(spec: mujoco.MjSpec, grip_force: float) -> None:
    opening = spec.add_tendon(name=f"{_NAME}/opening")
    opening.wrap_joint(f"{_NAME}/left", 1.0)
    opening.wrap_joint(f"{_NAME}/right", 1.0)
    drive = spec.add_actuator(
        name=f"{_NAME}/opening",
        trntype=mujoco.mjtTrn.mjTRN_TENDON,
        target=f"{_NAME}/opening",
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        forcerange=[-grip_force, grip_force],
    )
    drive.set_to_position(kp=FINGER_STIFFNESS, kv=finger_damping())
