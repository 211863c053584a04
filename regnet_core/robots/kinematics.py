"""Where a robot's hand is, and how to bring it to a pose: inverse kinematics with mink, from many starts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mink
import mujoco
import numpy as np
import numpy.typing as npt

from regnet_core.checks import as_transform, check_range
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Box
from regnet_core.gripper import Gripper
from regnet_core.robots.model import PREFIX, Robot, add_robot, hand_neighbours
from regnet_core.sim.world import world_spec

_HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
"""(X, Y, Z) and (X, -Y, -Z) are one grasp."""
_ROTATION_LENGTH = 0.4
"""In the distance between a start and a target, one radian counts as so many metres."""
_DIFFERENT = 0.1
"""Solutions differ in at least one joint by more than this [rad]."""
_SOLVER = "daqp"
_DAMPING = 1e-6


@dataclass(frozen=True)
class IKConfig:
    """How inverse kinematics is solved.

    Attributes:
        position_tolerance: a solution is at most so far off [m].
        rotation_tolerance: ... and turned by so much [rad].
        starts: most starts for each of the two orientations of a jaw.
        iterations: most steps from one start.
        bank: number of random configurations that starts are chosen from: those whose hand is nearest to the target.
        seed: of these configurations.
        clearance: the arm and the hand stay so far away from the table, other obstacles and the robot itself [m].

    Raises:
        InvalidInputError: a number is out of its range.
    """

    position_tolerance: float = 0.002
    rotation_tolerance: float = math.radians(1.0)
    starts: int = 24
    iterations: int = 30
    bank: int = 4096
    seed: int = 0
    clearance: float = 0.0

    def __post_init__(self) -> None:
        check_range("position_tolerance", self.position_tolerance, 1e-5, 0.1, "m")
        check_range("rotation_tolerance", self.rotation_tolerance, 1e-4, 1.0, "rad")
        check_range("starts", self.starts, 1, 1000)
        check_range("iterations", self.iterations, 1, 10_000)
        check_range("bank", self.bank, 1, 1_000_000)
        check_range("clearance", self.clearance, 0.0, 0.1, "m")


class IKResult(NamedTuple):
    """What inverse kinematics found."""

    success: bool
    """Whether the hand is at the pose within the tolerances, inside the joints' limits, and touches nothing."""
    q: Array
    """(n,) angles of the joints [rad]: the solution, or the best that was found."""
    position_error: float
    """[m]"""
    rotation_error: float
    """[rad]"""
    obstacle: str
    """Where the pose is reached, but only in collision: what touches what; else empty."""


class ArmKinematics:
    """The kinematics of one arm with our gripper, at a table with obstacles."""

    def __init__(
        self,
        robot: Robot,
        gripper: Gripper,
        table: Box,
        obstacles: Sequence[Box] = (),
        config: IKConfig = IKConfig(),
        carried: Box | None = None,
    ) -> None:
        """Build the model; takes some hundredths of a second.

        Args:
            robot: stands at the table.
            gripper: is mounted at the flange, its jaw open.
            table: the table's top in the world [m].
            obstacles: other boxes that arm and hand must not touch [m].
            config: tolerances and effort.
            carried: what the hand holds, as a box in the grasp frame, which must not touch the obstacles either [m].

        Raises:
            ModelError: the robot's model is not installed.
        """
        self.robot, self.gripper, self.config = robot, gripper, config
        hand = [*gripper.bodies(), *([] if carried is None else [carried])]
        self.model = _rigid_hand_model(robot, gripper, hand, table, obstacles, config.clearance)
        self._hand = self.model.body(HAND).id
        first = int(self.model.body_geomadr[self._hand])
        self._fingers = (first + 1, first + 2)  # after the palm
        self._configuration = mink.Configuration(self.model, np.array(robot.home))
        self._task = mink.FrameTask(HAND, "body", position_cost=1.0, orientation_cost=_ROTATION_LENGTH, lm_damping=1e-3)
        self._limits = [mink.ConfigurationLimit(self.model, gain=1.0)]
        self.lower, self.upper = self.model.jnt_range.T.copy()
        rng = np.random.default_rng(config.seed)
        self._bank = np.concatenate([[robot.home], rng.uniform(self.lower, self.upper, (config.bank, len(self.lower)))])
        self._bank_position, self._bank_quaternion = self._hands(self._bank)

    def set_opening(self, opening: float) -> None:
        """Open the jaw by so much for what follows, instead of wholly [m].

        Raises:
            GripperError: the jaw does not open so far.
        """
        bodies = self.gripper.bodies(opening)
        for geom, box in zip(self._fingers, (bodies.left_finger, bodies.right_finger), strict=True):
            self.model.geom_pos[geom] = 0.5 * (np.array(box.lower) + box.upper)

    def forward(self, q: npt.ArrayLike) -> Array:
        """T_world_grasp (4, 4): the grasp frame of the hand at joint angles (n,) [rad, m]."""
        self._configuration.update(np.asarray(q, float))
        return self._configuration.get_transform_frame_to_world(HAND, "body").as_matrix()

    def contact(self, q: npt.ArrayLike) -> str:
        """What touches what at joint angles (n,): "A touches B" with names of bodies; empty when nothing does."""
        self._configuration.update(np.asarray(q, float))
        return self._contact()

    def solve(
        self, T_world_grasp: npt.ArrayLike, near: npt.ArrayLike | None = None, symmetric: bool = True
    ) -> IKResult:
        """Joint angles that bring the hand to a pose.

        The first start is ``near``, where given; the others are those of the seeded configurations whose hands are
        nearest to the pose, the home pose among them. The same question gets the same answer.

        Args:
            T_world_grasp: (4, 4) pose of the grasp frame.
            near: (n,) angles to start from [rad]; the solution is then mostly close to them, with the orientation of
                the jaw that is nearer to theirs.
            symmetric: whether the hand turned by half a turn about its approach will do, as it does for a jaw.

        Raises:
            InvalidInputError: the pose is no rigid transform.
        """
        best = IKResult(False, np.array(self.robot.home), math.inf, math.inf, "")
        for found in self._descents(T_world_grasp, near, symmetric):
            if found.success:
                return found
            best = min(best, found, key=_distance)
        return best

    def solutions(
        self, T_world_grasp: npt.ArrayLike, near: npt.ArrayLike | None = None, symmetric: bool = True
    ) -> Iterator[IKResult]:
        """Different joint angles that bring the hand to a pose, as many as are found from all starts.

        Args and errors as of `solve`.
        """
        given: list[Array] = []
        for found in self._descents(T_world_grasp, near, symmetric):
            if found.success and all(np.abs(found.q - other).max() > _DIFFERENT for other in given):
                given.append(found.q)
                yield found

    def _descents(
        self, T_world_grasp: npt.ArrayLike, near: npt.ArrayLike | None, symmetric: bool
    ) -> Iterator[IKResult]:
        """What is found from each of the starts, for both orientations of a jaw in turn."""
        T = as_transform("T_world_grasp", T_world_grasp)
        if not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-4) or np.linalg.det(T[:3, :3]) < 0.0:
            raise InvalidInputError(f"T_world_grasp must be a rigid transform, got {T.tolist()}")
        targets = [T, T @ _HALF_TURN] if symmetric else [T]
        if symmetric and near is not None and (T[:3, 1] @ self.forward(near)[:3, 1]) < 0.0:
            targets.reverse()
        starts = [self._starts(target, near) for target in targets]
        for turn in zip(*starts, strict=True):
            for target, start in zip(targets, turn, strict=True):
                yield self._descend(target, start)

    def _starts(self, target: Array, near: npt.ArrayLike | None) -> list[Array]:
        quaternion = mink.SO3.from_matrix(target[:3, :3]).wxyz
        away = np.linalg.norm(self._bank_position - target[:3, 3], axis=1)
        turned = 2.0 * np.arccos(np.minimum(1.0, np.abs(self._bank_quaternion @ quaternion)))
        order = np.argsort(away + _ROTATION_LENGTH * turned, kind="stable")[: self.config.starts]
        chosen = [self._bank[i] for i in order]
        return chosen if near is None else [np.asarray(near, float), *chosen[:-1]]

    def _descend(self, target: Array, start: Array) -> IKResult:
        """From one start to the nearest place where the error does not fall any more."""
        config, task = self._configuration, self._task
        config.update(start)
        task.set_target(mink.SE3.from_matrix(target))
        position = rotation = math.inf
        for _ in range(self.config.iterations):
            error = task.compute_error(config)
            before = position + _ROTATION_LENGTH * rotation
            position, rotation = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
            # A tenth of the tolerance costs one more step, and leaves room for whoever executes it.
            if position < 0.1 * self.config.position_tolerance and rotation < 0.1 * self.config.rotation_tolerance:
                break
            if position + _ROTATION_LENGTH * rotation > 0.999 * before:
                break
            velocity = mink.solve_ik(config, [task], 1.0, _SOLVER, damping=_DAMPING, limits=self._limits)
            config.integrate_inplace(velocity, 1.0)
        else:
            error = task.compute_error(config)
            position, rotation = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
        q = np.clip(config.q, self.lower, self.upper)
        there = position <= self.config.position_tolerance and rotation <= self.config.rotation_tolerance
        obstacle = self._contact() if there else ""
        return IKResult(there and not obstacle, q, position, rotation, obstacle)

    def _contact(self) -> str:
        """The first contact of the configuration as it was last updated."""
        data = self._configuration.data
        mujoco.mj_collision(self.model, data)
        for contact in data.contact:
            if contact.dist < self.config.clearance:
                # What belongs to the robot first: body 0 is the world.
                first, second = sorted((int(self.model.geom_bodyid[geom]) for geom in contact.geom), reverse=True)
                return f"{self._name(first)} touches {self._name(second)}"
        return ""

    def _name(self, body: int) -> str:
        return self.model.body(body).name.removeprefix(PREFIX) if body else "the table or an obstacle"

    def _hands(self, configurations: Array) -> tuple[Array, Array]:
        """Positions (N, 3) [m] and quaternions (N, 4) w, x, y, z of the hand."""
        data = mujoco.MjData(self.model)
        positions, quaternions = np.empty((len(configurations), 3)), np.empty((len(configurations), 4))
        for i, q in enumerate(configurations):
            data.qpos[:] = q
            mujoco.mj_kinematics(self.model, data)
            positions[i], quaternions[i] = data.xpos[self._hand], data.xquat[self._hand]
        return positions, quaternions


HAND = "hand"
"""The body of the hand in the kinematic model; its frame is the grasp frame."""


def _rigid_hand_model(
    robot: Robot, gripper: Gripper, hand_boxes: Sequence[Box], table: Box, obstacles: Sequence[Box], clearance: float
) -> mujoco.MjModel:
    """The robot at the table, its jaw open and rigid, so that the arm's joints are all that moves."""
    spec = world_spec((), table, obstacles)
    flange = add_robot(spec, robot, robot.base_in(table))
    T = robot.flange_to_grasp(gripper)
    hand = flange.add_body(name=HAND, pos=T[:3, 3], quat=mink.SO3.from_matrix(T[:3, :3]).wxyz)
    for box in hand_boxes:
        lower, upper = np.array(box.lower), np.array(box.upper)
        hand.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=0.5 * (lower + upper), size=0.5 * (upper - lower))
    for name in hand_neighbours(robot, spec):
        spec.add_exclude(bodyname1=HAND, bodyname2=name)
    for geom in spec.geoms:
        geom.margin = clearance
    return spec.compile()


def _distance(result: IKResult) -> float:
    """How far a failure is from success: in collision is nearer than out of reach."""
    return (0.0 if result.obstacle else 1.0) + result.position_error + _ROTATION_LENGTH * result.rotation_error
