"""The robots' models: where they stand, what is mounted, where the hand is, against what is known of the machines."""

from __future__ import annotations

import importlib.util

import mujoco
import numpy as np
import pytest

from regnet_core.data.scenes.scene import default_table
from regnet_core.errors import ModelError
from regnet_core.gripper import Gripper
from regnet_core.robots.assets import robot_file
from regnet_core.robots.kinematics import HAND, ArmKinematics
from regnet_core.robots.model import PREFIX, ROBOTS, add_robot, get_robot, robot_spec
from regnet_core.robots.reach import work_table
from regnet_core.sim.config import SimConfig
from regnet_core.sim.gripper_model import jaw_index, mount_gripper
from regnet_core.sim.world import world_spec


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_has_its_seven_joints_with_limits_and_nothing_else_moves(name: str) -> None:
    robot = get_robot(name)
    model = robot_spec(robot).compile()
    assert [model.joint(i).name for i in range(model.njnt)] == list(robot.joints)
    assert model.nq == model.nv == 7 and model.nu == 0
    assert model.jnt_limited.all()
    assert (model.jnt_range[:, 0] < np.array(robot.home)).all() and (np.array(robot.home) < model.jnt_range[:, 1]).all()


def test_baxter_has_the_joint_limits_of_its_data_sheet() -> None:
    """Rethink Robotics, "Hardware specifications": degrees of S0 to W2."""
    model = robot_spec(get_robot("baxter")).compile()
    limits = [(-97.5, 97.5), (-123, 60), (-175, 175), (-2.86, 150), (-175.25, 175.25), (-90, 120), (-175.25, 175.25)]
    assert np.degrees(model.jnt_range) == pytest.approx(np.array(limits), abs=0.1)


def test_panda_stretched_out_reaches_as_far_as_its_links_are_long() -> None:
    """All joints at 0: 0.333 m to the shoulder, 0.316 to the elbow, 0.384 to the wrist, then down by 0.107."""
    gripper = Gripper()
    robot = get_robot("panda")
    arm = ArmKinematics(robot, gripper, work_table())
    T = arm.forward(np.zeros(7))
    base = robot.base_in(work_table())
    flange = np.array([0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.1065])
    assert T[:3, 3] - base[:3, 3] == pytest.approx(flange - [0.0, 0.0, gripper.palm_depth], abs=1e-4)
    assert T[:3, 0] == pytest.approx([0.0, 0.0, -1.0], abs=1e-4)  # the hand points down


def test_baxters_arms_mirror_each_other() -> None:
    arms = [ArmKinematics(get_robot(name), Gripper(), work_table()) for name in ("baxter", "baxter_left")]
    right, left = (arm.forward(arm.robot.home) for arm in arms)
    mirror = np.diag([1.0, -1.0, 1.0])
    assert left[:3, 3] == pytest.approx(mirror @ right[:3, 3], abs=1e-6)
    assert left[:3, 0] == pytest.approx(mirror @ right[:3, 0], abs=1e-6)


@pytest.mark.parametrize("name", ROBOTS)
def test_forward_kinematics_is_that_of_the_physics_and_of_the_chain_of_transforms(name: str) -> None:
    robot, gripper = get_robot(name), Gripper(width=0.1)
    arm = ArmKinematics(robot, gripper, work_table())
    spec = world_spec((), work_table())
    flange = add_robot(spec, robot, robot.base_in(work_table()))
    mount_gripper(spec, flange, robot.flange_to_grasp(gripper), gripper, SimConfig())
    model = spec.compile()
    data = mujoco.MjData(model)
    for q in np.random.default_rng(3).uniform(arm.lower, arm.upper, (5, 7)):
        data.qpos[:7] = q
        mujoco.mj_forward(model, data)
        hand = jaw_index(model).body
        T = arm.forward(q)
        assert T[:3, 3] == pytest.approx(data.xpos[hand], abs=1e-9)
        assert T[:3, :3].ravel() == pytest.approx(data.xmat[hand], abs=1e-9)
        assert _chain(arm, q) == pytest.approx(T, abs=1e-9)


def _chain(arm: ArmKinematics, q: np.ndarray) -> np.ndarray:
    """T_world_hand as the product of each body's fixed transform and its joint's turn about its axis."""
    model = arm.model
    T, body = np.eye(4), model.body(HAND).id
    while body:
        local = np.eye(4)
        local[:3, :3] = _matrix(model.body_quat[body])
        local[:3, 3] = model.body_pos[body]
        for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            w, half = model.jnt_axis[j], 0.5 * q[model.jnt_qposadr[j]]
            local[:3, :3] = local[:3, :3] @ _matrix(np.array([np.cos(half), *(np.sin(half) * w)]))
        T, body = local @ T, model.body_parentid[body]
    return T


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_the_flange_carries_the_hand_as_documented() -> None:
    gripper = Gripper(palm_depth=0.05)
    T = get_robot("baxter").flange_to_grasp(gripper)
    assert T[:3, 0].tolist() == [0.0, 0.0, 1.0]  # X, the approach, is the flange's z
    assert T[:3, 1].tolist() == [0.0, 1.0, 0.0]
    assert np.cross(T[:3, 0], T[:3, 1]) == pytest.approx(T[:3, 2])
    assert T[:3, 3].tolist() == [0.0, 0.0, 0.05]  # the palm's back is at the flange


def test_the_robot_stands_relative_to_the_middle_of_the_table() -> None:
    robot = get_robot("baxter")
    moved = default_table(height=1.0)
    shift = robot.base_in(moved)[:3, 3] - robot.base_in(default_table(height=0.7))[:3, 3]
    assert shift == pytest.approx([0.0, 0.0, 0.3])
    spec = world_spec((), moved)
    add_robot(spec, robot, robot.base_in(moved))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.body(f"{PREFIX}base").xpos == pytest.approx(np.add(robot.base_position, [0.0, 0.0, 1.0]))


@pytest.mark.parametrize("name", ROBOTS)
def test_at_home_nothing_touches_anything(name: str) -> None:
    robot = get_robot(name)
    arm = ArmKinematics(robot, Gripper(), work_table())
    assert arm.contact(robot.home) == ""


def test_an_unknown_robot_is_named_with_those_there_are() -> None:
    with pytest.raises(ModelError, match="no robot 'r2d2'; there are baxter, baxter_left, panda"):
        get_robot("r2d2")


def test_without_robosuite_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModelError, match=r"pip install --no-deps robosuite==1\.5\.2"):
        robot_file("baxter/robot.xml")


def test_a_robosuite_without_the_file_is_pointed_out() -> None:
    with pytest.raises(ModelError, match=r"no models/assets/robots/terminator/robot\.xml"):
        robot_file("terminator/robot.xml")
