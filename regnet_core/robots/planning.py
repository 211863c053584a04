"""All the ways of one pick, planned before the robot moves: to the pre-grasp, the grasp, up, over the other bin, home.

On its way to the pre-grasp and from bin to bin the arm goes around the obstacles; approach, lift and lowering are
straight lines of the hand. Objects in the bin are no obstacles: the detector has seen that the hand has room among
them. What the hand carries is taken for a box below the fingertips, which must clear the walls.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from regnet_core.geometry import Array, Box, transform_points
from regnet_core.gripper import Gripper
from regnet_core.robots.goal import GraspGoal
from regnet_core.robots.kinematics import ArmKinematics, IKConfig
from regnet_core.robots.layout import CellLayout
from regnet_core.robots.model import Robot
from regnet_core.robots.motion import PathError, free_path, line_path

_POSTURES = 4
"""Solutions of the grasp's inverse kinematics that are tried."""
_CLEARANCE = 0.005
"""Of paths around obstacles [m]."""
_NEAR_CLEARANCE = 0.003
"""Of straight lines, which go down between objects and walls: what the drives may be off [m]."""
_BETWEEN = 0.004
"""Spacing of the points between the fingers at which a wall is looked for, at most [m]."""
_CARRIED = (0.08, 0.07)
"""The carried box reaches so far beyond the fingertips, and to each side of their middle [m]."""
_ABOVE_RIM = 0.03
"""Of what is carried, and of the fingertips that let go, above the bins' rim [m]."""
_SPREAD = (0.06, 0.04)
"""Objects are put down so far from the middle of the bin, along x and y [m]."""
_YAWS = np.radians([0.0, 90.0, 45.0, -45.0])
"""Turns of the hand about the vertical that are tried where it puts down [rad]."""


class GraspWay(NamedTuple):
    """Configurations (n,) [rad] along the first part of a pick."""

    approach: list[Array]
    """From the pre-grasp to the grasp."""
    lift: list[Array]
    """From the grasp straight up until what is held clears the walls."""


class Plan(NamedTuple):
    """Configurations (n,) [rad] along each part of a pick."""

    reach: list[Array]
    approach: list[Array]
    lift: list[Array]
    carry: list[Array]
    """Over the bin to place into, and down."""
    leave: list[Array]
    """Up and home."""


class Planner:
    """Plans for one robot in one cell."""

    def __init__(self, robot: Robot, gripper: Gripper, layout: CellLayout, ik: IKConfig = IKConfig()) -> None:
        """Builds three kinematic models: of the bare hand, of one that keeps clear, of one that carries something."""
        self.robot, self._gripper, self._layout = robot, gripper, layout
        near = replace(ik, clearance=max(_NEAR_CLEARANCE, ik.clearance))
        careful = replace(ik, clearance=max(_CLEARANCE, ik.clearance))
        beyond, side = _CARRIED
        self._box = Box((0.0, -side, -side), (gripper.depth + beyond, side, side))
        self._close = ArmKinematics(robot, gripper, layout.table, layout.fixtures, near)
        self._clear = ArmKinematics(robot, gripper, layout.table, layout.fixtures, careful)
        self._loaded = ArmKinematics(robot, gripper, layout.table, layout.fixtures, ik, carried=self._box)
        self._rim = layout.place_bin.inside.upper[2]

    def reachable(self, goal: GraspGoal) -> GraspWay:
        """The straight parts of a pick: from pre-grasp to grasp and up. Quick, as the way there is not planned.

        Raises:
            PathError: the arm does not reach the grasp, or cannot go along a line; the message says what is in the way.
        """
        self._set_opening(goal.opening)
        return next(self._grasp_ways(goal))

    def plan(self, goal: GraspGoal, start: Array, placed: int = 0) -> Plan:
        """Everything, from a configuration (n,) [rad] back home.

        Args:
            goal: the grasp.
            start: where the arm is.
            placed: number of objects put down before: they are spread over the bin.

        Raises:
            PathError: a part is not possible; the message says which, and what is in the way.
        """
        self._set_opening(goal.opening)
        reason = PathError("the arm does not reach the grasp")
        for way in self._grasp_ways(goal):
            try:
                reach = free_path(self._clear, start, way.approach[0])
                carry = self._carry(way.lift[-1], placed)
                return Plan(reach, way.approach, way.lift, carry, self._leave(carry[-1]))
            except PathError as error:
                reason = error
        raise reason

    def position(self, q: Array) -> Array:
        """(3,) of the grasp frame's origin at a configuration (n,) [m]."""
        return self._close.forward(q)[:3, 3]

    def _set_opening(self, opening: float) -> None:
        for arm in (self._close, self._clear):
            arm.set_opening(opening)

    def _leave(self, start: Array) -> list[Array]:
        """From where something was put down straight up, then home. Beyond the walls the jaw has room to be open."""
        up = self._close.forward(start)
        up[2, 3] += 0.1
        line = line_path(self._close, start, up)
        return [*line, *free_path(self._clear, line[-1], np.array(self.robot.home))[1:]]

    def _grasp_ways(self, goal: GraspGoal) -> Iterator[GraspWay]:
        """One for each posture of the arm that allows it.

        Raises:
            PathError: none does; the reason is that of the posture that was tried last.
        """
        if self._grips_fixture(goal):
            raise PathError("a part of a bin is between the fingers")
        reason: PathError | None = None
        any_way = False
        for found in islice(self._close.solutions(goal.grasp, near=self.robot.home), _POSTURES):
            try:
                way = self._grasp_way(goal, found.q)
            except PathError as error:
                reason = error
                continue
            any_way = True
            yield way
        if not any_way:
            best = self._close.solve(goal.grasp, near=self.robot.home)
            blocked = f"at the grasp, {best.obstacle}" if best.obstacle else "the arm does not reach the grasp"
            raise reason or PathError(blocked)

    def _grips_fixture(self, goal: GraspGoal) -> bool:
        """Whether the jaw would close on the floor or a wall of a bin, with or without an object."""
        region = self._gripper.closing_region(goal.opening)
        axes = [
            np.linspace(low, high, 1 + math.ceil((high - low) / _BETWEEN))
            for low, high in zip(region.lower, region.upper, strict=True)
        ]
        local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        points = transform_points(goal.grasp, local)
        return any(bool(box.contains(points).any()) for box in self._layout.fixtures)

    def _grasp_way(self, goal: GraspGoal, q: Array) -> GraspWay:
        grasp = self._close.forward(q)  # one of the two orientations of the jaw
        before, up = grasp.copy(), grasp.copy()
        before[:3, 3] = goal.pre_grasp[:3, 3]
        up[:3, 3] = goal.lift[:3, 3]
        lowest = float((self._box.corners() @ grasp[2, :3]).min()) + up[2, 3]
        up[2, 3] += max(0.0, self._rim + _ABOVE_RIM - lowest)
        try:
            approach = line_path(self._close, q, before)[::-1]
        except PathError as error:
            raise PathError(f"approach: {error}") from error
        try:
            lift = line_path(self._close, q, up)
        except PathError as error:
            raise PathError(f"lift: {error}") from error
        return GraspWay(approach, lift)

    def _carry(self, start: Array, placed: int) -> list[Array]:
        """Over the other bin and down into it, with what the hand holds."""
        reason: PathError | None = None
        for yaw in _YAWS:
            down = self._place_pose(yaw, placed)
            above = down.copy()
            above[2, 3] += self._gripper.depth + _CARRIED[0]
            found = self._loaded.solve(above, near=start)
            try:
                if not found.success:
                    raise PathError(found.obstacle or "the arm does not reach the bin to place into")
                path = free_path(self._loaded, start, found.q)
                held = self._loaded.forward(found.q)
                held[2, 3] = down[2, 3]
                return [*path, *line_path(self._loaded, found.q, held)[1:]]
            except PathError as error:
                reason = PathError(f"place: {error}")
        raise reason or PathError("place: no pose to put down at")

    def _place_pose(self, yaw: float, placed: int) -> Array:
        """(4, 4): the hand points straight down, its fingertips just above the rim."""
        signs = np.array([(-1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (1.0, -1.0)])[placed % 4]
        approach = np.array([0.0, 0.0, -1.0])
        closing = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([approach, closing, np.cross(approach, closing)], axis=1)
        pose[:2, 3] = np.array(self._layout.place) + signs * _SPREAD
        pose[2, 3] = self._rim + _ABOVE_RIM + self._gripper.depth
        return pose
