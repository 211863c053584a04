"""Paths of the arm: from one configuration to another around obstacles, along a line, and how fast they are run."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from regnet_core.errors import RegnetError
from regnet_core.geometry import Array
from regnet_core.robots.kinematics import ArmKinematics

STEP = 0.04
"""A path is checked for collisions at steps in which no joint moves more [rad]."""
_REACH = 0.4
"""The tree of the search grows by so much at most [rad], the largest of the joints."""
_TRIES = 1500
"""Samples of the search."""
_SHORTCUTS = 60
_LINE_STEP = 0.01
"""Between two poses on a line for which inverse kinematics is solved [m]."""
_JUMP = 0.35
"""Neighbours on a line differ by less in each joint [rad]: more means that the arm would swing to another posture."""


class PathError(RegnetError):
    """There is no way; the message says where it ends."""


class Setpoint(NamedTuple):
    """What the drives aim at in one instant."""

    q: Array
    """(n,) [rad]"""
    velocity: Array
    """(n,) [rad/s]"""


def free_path(arm: ArmKinematics, start: Array, goal: Array, seed: int = 0) -> list[Array]:
    """Configurations from start to goal, straight lines between which touch nothing: RRT-Connect, then shortcuts.

    Args:
        arm: knows the obstacles.
        start, goal: (n,) [rad].
        seed: of the search.

    Raises:
        PathError: the start or the goal is in collision, or none was found.
    """
    for name, q in (("the start", start), ("the end", goal)):
        if touching := arm.contact(q):
            raise PathError(f"no way: at {name}, {touching}")
    if _is_free(arm, start, goal):
        return [start, goal]
    rng = np.random.default_rng(seed)
    path = _connect(arm, start, goal, rng)
    if path is None:
        raise PathError(f"no way around the obstacles was found in {_TRIES} tries")
    return _shortened(arm, path, rng)


def line_path(arm: ArmKinematics, start: Array, T_end: Array) -> list[Array]:
    """Configurations along which the hand moves on a straight line from where it is to a pose, without a swing.

    Args:
        arm: knows the obstacles.
        start: (n,) [rad].
        T_end: (4, 4) pose at the end, of the same orientation as at the start.

    Raises:
        PathError: the line leaves what the arm reaches, or touches something.
    """
    T_start = arm.forward(start)
    length = float(np.linalg.norm(T_end[:3, 3] - T_start[:3, 3]))
    count = max(1, math.ceil(length / _LINE_STEP))
    path = [start]
    for i in range(1, count + 1):
        pose = T_end.copy()
        pose[:3, 3] = T_start[:3, 3] + i / count * (T_end[:3, 3] - T_start[:3, 3])
        found = arm.solve(pose, near=path[-1], symmetric=False)
        where = f"{i / count * length:.3f} of {length:.3f} m along the line"
        if not found.success:
            raise PathError(f"{found.obstacle or 'the arm does not reach further'}, {where}")
        if np.abs(found.q - path[-1]).max() > _JUMP:
            raise PathError(f"the arm would have to swing to another posture, {where}")
        path.append(found.q)
    return path


def timed(path: Sequence[Array], speeds: Array, timestep: float, least: float = 0.0) -> Iterator[Setpoint]:
    """Setpoints along a path from rest to rest, the speed rising and falling as a parabola over its length.

    Args:
        path: (n,) configurations [rad].
        speeds: (n,) largest speed of each joint [rad/s].
        timestep: between two setpoints [s].
        least: least duration [s].
    """
    points = np.array(path)
    # Lengths in time: each stretch takes as long as its slowest joint at its largest speed.
    stretch = (np.abs(np.diff(points, axis=0)) / speeds).max(axis=1) if len(points) > 1 else np.zeros(0)
    points, stretch = np.concatenate([points[:1], points[1:][stretch > 1e-9]]), stretch[stretch > 1e-9]
    if not len(stretch):
        return
    knots = np.concatenate([[0.0], np.cumsum(stretch)])
    duration = max(1.5 * knots[-1], least)  # the parabola's peak is 1.5 times its mean
    steps = math.ceil(duration / timestep)
    slopes = np.diff(points, axis=0) / stretch[:, None]
    for i in range(1, steps + 1):
        s = i / steps
        place = (3.0 - 2.0 * s) * s * s * knots[-1]
        k = min(int(np.searchsorted(knots, place, side="right")) - 1, len(slopes) - 1)
        rate = 6.0 * s * (1.0 - s) * knots[-1] / duration
        yield Setpoint(points[k] + (place - knots[k]) * slopes[k], rate * slopes[k])


def _is_free(arm: ArmKinematics, start: Array, goal: Array) -> bool:
    """Whether the straight line in joint space touches nothing; its ends are not looked at."""
    count = math.ceil(float(np.abs(goal - start).max()) / STEP)
    # From coarse to fine: most collisions are found in the first looks.
    order = sorted(range(1, count), key=lambda i: -(i & -i))
    return not any(arm.contact(start + i / count * (goal - start)) for i in order)


def _connect(arm: ArmKinematics, start: Array, goal: Array, rng: np.random.Generator) -> list[Array] | None:
    """Two trees that grow towards random configurations and towards each other."""
    trees = (_Tree(start), _Tree(goal))
    for i in range(_TRIES):
        one, other = trees if i % 2 == 0 else trees[::-1]
        new = one.grow(arm, rng.uniform(arm.lower, arm.upper))
        if new is None:
            continue
        target = one.nodes[new]
        while (met := other.grow(arm, target)) is not None:
            if np.abs(other.nodes[met] - target).max() < 1e-9:
                forth, back = one.branch(new), other.branch(met)
                path = [*forth[::-1], *back[1:]]
                return path if one is trees[0] else path[::-1]
    return None


class _Tree:
    """Configurations that are reached from a root by free straight lines."""

    def __init__(self, root: Array) -> None:
        self.nodes = [root]
        self._parents = [-1]

    def grow(self, arm: ArmKinematics, target: Array) -> int | None:
        """One step towards the target, or onto it; the new node, None where something is in the way."""
        nearest = int(np.abs(np.array(self.nodes) - target).max(axis=1).argmin())
        start = self.nodes[nearest]
        away = float(np.abs(target - start).max())
        end = target if away <= _REACH else start + _REACH / away * (target - start)
        if arm.contact(end) or not _is_free(arm, start, end):
            return None
        self.nodes.append(end)
        self._parents.append(nearest)
        return len(self.nodes) - 1

    def branch(self, node: int) -> list[Array]:
        """From a node back to the root."""
        path = []
        while node >= 0:
            path.append(self.nodes[node])
            node = self._parents[node]
        return path


def _shortened(arm: ArmKinematics, path: list[Array], rng: np.random.Generator) -> list[Array]:
    """Leaves out detours where the straight line is free."""
    for _ in range(_SHORTCUTS):
        if len(path) <= 2:
            break
        i, j = sorted(int(k) for k in rng.choice(len(path), 2, replace=False))
        if j - i > 1 and _is_free(arm, path[i], path[j]):
            path = [*path[: i + 1], *path[j:]]
    return path
