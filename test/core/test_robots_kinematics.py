"""Inverse kinematics: what can be reached is found, what cannot is refused, and obstacles are kept clear of."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Box
from regnet_core.gripper import Gripper
from regnet_core.robots.kinematics import ArmKinematics, IKConfig
from regnet_core.robots.model import get_robot
from regnet_core.robots.reach import work_table

TABLE = work_table()
TOP = TABLE.upper[2]


@pytest.fixture(scope="module", params=["baxter", "panda"])
def arm(request: pytest.FixtureRequest) -> ArmKinematics:
    return ArmKinematics(get_robot(request.param), Gripper(), TABLE)


@pytest.fixture(scope="module")
def baxter() -> ArmKinematics:
    return ArmKinematics(get_robot("baxter"), Gripper(), TABLE)


def downwards(x: float, y: float, height: float, yaw: float = 0.0) -> Array:
    """A hand that points straight down, its fingertips at a place above the table's middle [m, rad]."""
    T = np.eye(4)
    Y = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    X = np.array([0.0, 0.0, -1.0])
    T[:3, :3] = np.stack([X, Y, np.cross(X, Y)], axis=1)
    T[:3, 3] = [x, y, TOP + height + Gripper().depth]
    return T


def free_configurations(arm: ArmKinematics, count: int) -> list[Array]:
    rng = np.random.default_rng(11)
    found: list[Array] = []
    while len(found) < count:
        q = rng.uniform(arm.lower, arm.upper)
        if not arm.contact(q):
            found.append(q)
    return found


def off_by(arm: ArmKinematics, q: Array, target: Array) -> tuple[float, float]:
    """Position [m] and rotation [rad] between the hand at q and a pose, by forward kinematics in fresh data."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = q
    mujoco.mj_forward(arm.model, data)
    hand = data.body("hand")
    turn = Rotation.from_matrix(hand.xmat.reshape(3, 3).T @ target[:3, :3]).magnitude()
    return float(np.linalg.norm(hand.xpos - target[:3, 3])), float(turn)


def test_poses_of_random_configurations_are_found_again(arm: ArmKinematics) -> None:
    solved = 0
    configurations = free_configurations(arm, 200)
    for q in configurations:
        target = arm.forward(q)
        result = arm.solve(target, symmetric=False)
        if result.success:
            solved += 1
            position, rotation = off_by(arm, result.q, target)
            assert position <= 0.002 and rotation <= math.radians(1.0)
            assert ((arm.lower <= result.q) & (result.q <= arm.upper)).all()
    assert solved >= 0.99 * len(configurations)


def test_errors_that_are_reported_are_those_of_the_hand(baxter: ArmKinematics) -> None:
    result = baxter.solve(downwards(0.0, 0.0, 0.05))
    target = downwards(0.0, 0.0, 0.05)
    position, rotation = off_by(baxter, result.q, target)
    if rotation > 1.0:  # it took the other of the jaw's two orientations
        position, rotation = off_by(baxter, result.q, target @ np.diag([1.0, -1.0, -1.0, 1.0]))
    assert result.success
    assert (position, rotation) == pytest.approx((result.position_error, result.rotation_error), abs=1e-6)


def test_a_pose_beyond_the_arms_length_is_refused_with_its_error(arm: ArmKinematics) -> None:
    far = downwards(3.0, 0.0, 0.2)
    result = arm.solve(far)
    assert not result.success and result.obstacle == ""
    assert result.position_error > 1.0
    assert np.isfinite(result.q).all()


def test_a_pose_in_the_table_is_refused_and_named(arm: ArmKinematics) -> None:
    result = arm.solve(downwards(0.0, 0.0, -0.02))
    assert not result.success
    assert "touches" in result.obstacle and "the table or an obstacle" in result.obstacle and "hand" in result.obstacle


def test_an_obstacle_keeps_the_hand_away(baxter: ArmKinematics) -> None:
    target = downwards(0.0, 0.0, 0.03)
    assert baxter.solve(target).success
    wall = Box((-0.02, -0.2, TOP), (0.02, 0.2, TOP + 0.15))
    walled = ArmKinematics(get_robot("baxter"), Gripper(), TABLE, [wall])
    assert not walled.solve(target).success
    assert walled.solve(downwards(0.0, 0.0, 0.2)).success


def test_a_clearance_is_kept(baxter: ArmKinematics) -> None:
    near = downwards(0.0, 0.0, 0.005)
    careful = ArmKinematics(get_robot("baxter"), Gripper(), TABLE, config=IKConfig(clearance=0.02))
    assert baxter.solve(near).success
    assert not careful.solve(near).success
    assert careful.solve(downwards(0.0, 0.0, 0.025)).success


def test_the_other_orientation_of_a_jaw_will_do_only_where_it_is_allowed(baxter: ArmKinematics) -> None:
    for q in free_configurations(baxter, 10):
        turned = baxter.forward(q) @ np.diag([1.0, -1.0, -1.0, 1.0])
        assert baxter.solve(turned, near=q, symmetric=True).q == pytest.approx(q, abs=1e-3)
        exact = baxter.solve(turned, near=q, symmetric=False)
        assert not exact.success or off_by(baxter, exact.q, turned)[1] < math.radians(1.0)


def test_a_solution_stays_near_where_it_is_asked_to(baxter: ArmKinematics) -> None:
    first = baxter.solve(downwards(0.0, 0.0, 0.05))
    lifted = baxter.forward(first.q)
    lifted[2, 3] += 0.02
    second = baxter.solve(lifted, near=first.q, symmetric=False)
    assert second.success
    assert np.abs(second.q - first.q).max() < 0.2


def test_the_same_question_gets_the_same_answer(baxter: ArmKinematics) -> None:
    again = ArmKinematics(get_robot("baxter"), Gripper(), TABLE)
    target = downwards(0.1, -0.1, 0.08, yaw=0.7)
    baxter.solve(downwards(-0.1, 0.0, 0.05))
    assert (baxter.solve(target).q == again.solve(target).q).all()


def test_a_matrix_that_is_no_pose_is_refused(baxter: ArmKinematics) -> None:
    with pytest.raises(InvalidInputError, match="must be a rigid transform"):
        baxter.solve(np.diag([2.0, 1.0, 1.0, 1.0]))
    with pytest.raises(InvalidInputError, match="finite"):
        baxter.solve(np.full((4, 4), np.nan))


@pytest.mark.parametrize("wrong", [{"starts": 0}, {"position_tolerance": 0.0}, {"clearance": -0.1}])
def test_settings_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(wrong))):
        IKConfig(**wrong)  # type: ignore[arg-type]
