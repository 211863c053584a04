"""A simulated work cell: a robot that picks objects from one bin and puts them into another, in MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from regnet_core.checks import check_range
from regnet_core.data.cameras.rendering import SceneRenderer
from regnet_core.data.scenes.scene import Scene
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Box, transform_points
from regnet_core.gripper import Gripper
from regnet_core.robots.cell_physics import CellPhysics
from regnet_core.robots.drive import Drive
from regnet_core.robots.goal import GraspGoal
from regnet_core.robots.layout import CellLayout, fill
from regnet_core.robots.model import get_robot
from regnet_core.robots.motion import PathError
from regnet_core.robots.picking import DONE_BEFORE, Phase, Pick, PickOutcome, PickStopped, Watch
from regnet_core.robots.planning import Plan, Planner
from regnet_core.sim.config import SimConfig

_UNMOVED = 0.003
"""Objects that moved by less are where they were [m]."""
_HEAP = 0.1
"""The objects in a bin rise above its rim by less than this [m]."""


class PickResult(NamedTuple):
    """What came of a pick."""

    outcome: PickOutcome
    message: str
    """One sentence for people."""
    disturbed: bool
    """Whether an object is no longer where it was, so that what was seen before does not hold any more."""
    duration: float
    """Simulated time [s]."""

    @property
    def success(self) -> bool:
        """Whether the object is where it should be."""
        return self.outcome is PickOutcome.PLACED


@dataclass(frozen=True)
class CellConfig:
    """What is in the cell.

    Attributes:
        robot: one of ROBOTS.
        gripper: at its flange.
        objects: in the bin to pick from.
        seed: of the objects and of the camera's noise.
        layout: where things are.
        sim: of the physics and the hand. The arm moves at the robot's speeds, on lines at `approach_speed`.
        stop_force: hand or arm stop when they press with more than this before closing [N].

    Raises:
        InvalidInputError: a number is out of its range, or there is no such robot.
    """

    robot: str = "baxter"
    gripper: Gripper = field(default_factory=Gripper)
    objects: int = 5
    seed: int = 0
    layout: CellLayout = field(default_factory=CellLayout)
    sim: SimConfig = field(default_factory=lambda: SimConfig(timestep=0.002))
    stop_force: float = 15.0

    def __post_init__(self) -> None:
        get_robot(self.robot)
        check_range("objects", self.objects, 0, 20)
        check_range("seed", self.seed, 0, 2**31 - 1)
        check_range("stop_force", self.stop_force, 0.1, 1000.0, "N")


class WorkCell:
    """One robot, its cell, and the state of both. Not for several threads at once."""

    def __init__(self, config: CellConfig = CellConfig(), scene: Scene | None = None) -> None:
        """Fills the bin and builds physics and kinematics; takes some seconds.

        Args:
            config: what is in the cell.
            scene: objects at rest in the layout's bins, instead of those that the seed gives.

        Raises:
            ModelError: the robot's model is not installed.
            InvalidInputError: the library has not so many objects that fit the gripper.
        """
        self.config, self.layout = config, config.layout
        self.robot = get_robot(config.robot)
        self.planner = Planner(self.robot, config.gripper, config.layout)
        self.scene = scene or fill(config.layout, config.objects, config.gripper, config.seed)
        self.physics = CellPhysics(self.scene, self.robot, config.gripper, config.sim)
        self._drive = Drive(self.physics, np.array(self.robot.home), config.gripper.width, config.sim)
        self._rng = np.random.default_rng([config.seed, 1])

    def poses(self) -> Array:
        """(K, 4, 4) T_world_object."""
        return self.physics.object_poses()

    def restore(self, poses: Array) -> None:
        """Puts the objects at rest at poses (K, 4, 4) that an earlier cell of the same configuration had.

        Raises:
            InvalidInputError: the poses are not of these objects.
        """
        if poses.shape != self.scene.poses.shape or not np.isfinite(poses).all():
            raise InvalidInputError(f"poses must be finite, of shape {self.scene.poses.shape}, got {poses.shape}")
        self.physics.place_objects(poses)

    @property
    def to_pick(self) -> tuple[int, ...]:
        """Indices of the objects in the bin to pick from."""
        return self._inside(self.layout.pick_bin.inside)

    @property
    def placed(self) -> tuple[int, ...]:
        """Indices of the objects in the bin to place into."""
        return self._inside(self.layout.place_bin.inside)

    def capture(self) -> tuple[Array, NDArray[np.uint8]]:
        """What the camera sees of the bin to pick from, with fresh noise.

        The arm waits out of the camera's sight, and is not drawn.

        Returns:
            Points (N, 3) in the camera's optical frame [m] and their colours (N, 3).
        """
        scene = Scene(self.scene.objects, self.poses(), self.layout.table, self.layout.fixtures)
        device, camera = self.layout.device, self.layout.camera
        view = SceneRenderer(scene).render(camera, device.noise, self._rng, region=self.layout.view)
        points, pixels = view.cloud()
        T_camera_world = np.linalg.inv(camera.T_world_camera)
        return transform_points(T_camera_world, points), view.colours.reshape(-1, 3)[pixels]

    def check(self, goal: GraspGoal) -> str:
        """Why the arm cannot execute a grasp, as far as is quickly known; empty where it seems to be able to.

        Raises:
            InvalidInputError: a pose is no rigid transform.
        """
        try:
            self.planner.reachable(goal)
        except PathError as error:
            return str(error)
        return ""

    def pick(self, goal: GraspGoal, watch: Watch = lambda phase, progress: True) -> PickResult:
        """Executes a grasp, puts the object into the other bin, and brings the arm home, whatever happens.

        Raises:
            InvalidInputError: the opening is not in (0, W], or a pose is no rigid transform.
        """
        if not 0.0 < goal.opening <= self.config.gripper.width + 1e-9:
            raise InvalidInputError(
                f"the opening must be in (0, {self.config.gripper.width:g}] m, got {goal.opening:g}"
            )
        start, before = self.physics.time, self.poses()
        try:
            plan = self.planner.plan(goal, self._drive.q, len(self.placed))
        except PathError as error:
            return PickResult(PickOutcome.UNREACHABLE, f"unreachable: {error}", False, 0.0)
        outcome, message = self._execute(plan, goal, watch)
        moved = np.linalg.norm(self.poses()[:, :3, 3] - before[:, :3, 3], axis=1)
        return PickResult(outcome, message, bool((moved > _UNMOVED).any()), self.physics.time - start)

    def _execute(self, plan: Plan, goal: GraspGoal, watch: Watch) -> tuple[PickOutcome, str]:
        drive, width = self._drive, self.config.gripper.width
        pick = Pick(drive, [model.name for model in self.scene.objects], watch, self.config.stop_force)
        try:
            done = pick.run(plan, self.planner.position, goal.opening, width)
        except PickStopped as stop:
            drive.set_opening(width)
            drive.go_back()
            drive.wait_for_rest()
            return stop.outcome, stop.message
        watch(Phase.RETURN, DONE_BEFORE[Phase.RETURN])
        drive.follow(plan.leave)
        name = self.scene.objects[done.item].name
        if done.item not in self.placed:
            return PickOutcome.DROPPED, f"{name} was let go, but does not lie in the bin"
        return PickOutcome.PLACED, f"{name} was lifted by {done.rise:.2f} m and placed; {len(self.to_pick)} left"

    def _inside(self, box: Box) -> tuple[int, ...]:
        """Objects with their centre between the walls of a bin, and not far above them."""
        centre = self.physics.object_poses()[:, :3, 3]
        heap = Box((*box.lower[:2], box.lower[2] - 0.01), (*box.upper[:2], box.upper[2] + _HEAP))
        return tuple(int(k) for k in np.flatnonzero(heap.contains(centre)))
