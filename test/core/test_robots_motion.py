"""Paths of the arm: free of obstacles, straight where they should be, and within the joints' speeds."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from regnet_core.geometry import Array, Box
from regnet_core.gripper import Gripper
from regnet_core.robots.kinematics import ArmKinematics
from regnet_core.robots.model import get_robot
from regnet_core.robots.motion import PathError, free_path, line_path, timed
from regnet_core.robots.reach import work_table

TOP = work_table().upper[2]
WALL = Box((-0.15, -0.02, TOP), (0.25, 0.02, TOP + 0.25))
"""Between the two sides of the table."""


def side(arm: ArmKinematics, y: float, height: float = 0.1) -> Array:
    """Joint angles with which the hand points straight down, its fingertips above a side of the table."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    T[:3, 3] = [0.0, y, TOP + height + Gripper().depth]
    found = arm.solve(T, near=arm.robot.home)
    assert found.success
    return found.q


@pytest.fixture(scope="module")
def arm() -> ArmKinematics:
    return ArmKinematics(get_robot("panda"), Gripper(), work_table(), [WALL])


def densely(path: list[Array]) -> Array:
    """The path's configurations, 0.01 rad apart."""
    pieces = [np.linspace(a, b, 2 + int(np.abs(b - a).max() / 0.01)) for a, b in pairwise(path)]
    return np.concatenate(pieces)


def test_a_path_goes_around_a_wall(arm: ArmKinematics) -> None:
    start, goal = side(arm, -0.15), side(arm, 0.15)
    straight = [start, goal]
    assert any(arm.contact(q) for q in densely(straight))  # else there would be nothing to test
    path = free_path(arm, start, goal)
    assert (path[0] == start).all() and (path[-1] == goal).all() and len(path) > 2
    assert not any(arm.contact(q) for q in densely(path))
    assert all((arm.lower <= q).all() and (q <= arm.upper).all() for q in path)


def test_a_path_with_nothing_in_its_way_is_straight(arm: ArmKinematics) -> None:
    start, goal = side(arm, -0.15), side(arm, -0.25)
    assert len(free_path(arm, start, goal)) == 2


def test_there_is_no_path_to_or_from_a_collision(arm: ArmKinematics) -> None:
    bare = ArmKinematics(get_robot("panda"), Gripper(), work_table())
    inside = side(bare, 0.0)  # in the wall
    with pytest.raises(PathError, match=r"at the end, .* touches"):
        free_path(arm, side(arm, -0.15), inside)
    with pytest.raises(PathError, match=r"at the start, .* touches"):
        free_path(arm, inside, side(arm, -0.15))


def test_a_line_is_straight_and_does_not_turn_the_hand(arm: ArmKinematics) -> None:
    start = side(arm, -0.15, height=0.05)
    T_end = arm.forward(start)
    T_end[:3, 3] += [0.03, -0.06, 0.1]
    path = line_path(arm, start, T_end)
    first, last = arm.forward(start)[:3, 3], T_end[:3, 3]
    direction = (last - first) / np.linalg.norm(last - first)
    for q in densely(path):
        T = arm.forward(q)
        away = T[:3, 3] - first
        assert np.linalg.norm(away - (away @ direction) * direction) < 0.002
        assert np.arccos(np.clip(0.5 * (np.trace(T[:3, :3].T @ T_end[:3, :3]) - 1.0), -1.0, 1.0)) < np.radians(2.0)
    assert arm.forward(path[-1])[:3, 3] == pytest.approx(last, abs=0.002)


def test_a_line_through_an_obstacle_or_out_of_reach_is_refused(arm: ArmKinematics) -> None:
    start = side(arm, -0.15)
    through, away = arm.forward(start), arm.forward(start)
    through[1, 3] += 0.3
    away[0, 3] += 1.5
    with pytest.raises(PathError, match=r"link7 touches the table or an obstacle, 0\.080 of 0\.300 m"):
        line_path(arm, start, through)
    with pytest.raises(PathError, match="along the line"):
        line_path(arm, start, away)


def test_setpoints_keep_to_the_path_and_to_the_speeds() -> None:
    path = [np.array([0.0, 0.0]), np.array([0.5, 0.1]), np.array([0.5, 0.9])]
    speeds, dt = np.array([1.0, 2.0]), 0.002
    points = list(timed(path, speeds, dt))
    q = np.array([point.q for point in points])
    assert q[-1] == pytest.approx(path[-1])
    rate = np.diff(np.concatenate([[path[0]], q]), axis=0) / dt
    assert (np.abs(rate) <= speeds + 1e-6).all()
    assert np.abs(rate).max(axis=0) == pytest.approx(speeds, rel=0.35)  # nor is it slower than it need be
    assert np.abs(rate[[0, -1]]).max() < 0.05  # from rest to rest
    # The velocities are those of the positions, but where the path has a corner.
    wrong = np.abs(rate - [point.velocity for point in points]).max(axis=1) > 0.02
    assert wrong.sum() <= 2
    # Every point is on one of the two stretches.
    on_first = np.abs(q[:, 1] - 0.2 * q[:, 0]) < 1e-9
    on_second = np.abs(q[:, 0] - 0.5) < 1e-9
    assert (on_first | on_second).all()


def test_a_least_duration_is_kept_and_a_path_of_no_length_takes_none() -> None:
    path = [np.zeros(2), np.array([0.1, 0.0])]
    assert len(list(timed(path, np.ones(2), 0.01, least=2.0))) == 200
    assert list(timed([np.zeros(2)], np.ones(2), 0.01, least=2.0)) == []
    assert list(timed([np.zeros(2), np.zeros(2)], np.ones(2), 0.01)) == []
