"""Which grasps a robot reaches: poses drawn over the space above its table, and inverse kinematics for each.

The distribution. Fingertips are uniform in a box over the middle of the table, in which bins and heaps stand; the
hand's orientation is uniform over all rotations, so that approaches are uniform over the sphere. A pose counts as
reached when the arm can bring the hand to it and to the pre-grasp behind it without touching the table or itself.
Objects are no obstacles here: what they are in the way of is the business of the detector and of P(grasp | reach).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from regnet_core.approach import pre_grasp_poses
from regnet_core.checks import check_range
from regnet_core.coder import vertical_score
from regnet_core.data.generation.executors import Executor
from regnet_core.data.scenes.scene import default_table
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Box
from regnet_core.gripper import Gripper
from regnet_core.robots.kinematics import ArmKinematics, IKConfig
from regnet_core.robots.model import get_robot

TABLE_SIDE = 0.8
"""Of the square table that a robot works at [m]: the robot stands at its edge."""
_CHUNK = 100
"""Poses in one piece of work."""
REACHED, OUT_OF_REACH, IN_COLLISION, NO_PRE_GRASP = "reached", "out of reach", "in collision", "no pre-grasp"


@dataclass(frozen=True)
class ReachSettings:
    """What is sampled.

    Attributes:
        robot: one of ROBOTS.
        samples: number of poses.
        seed: of the poses.
        gripper: at the flange.
        half_side: fingertips are so far from the middle of the table at most, along x and y [m].
        heights: least and greatest height of fingertips above the table [m].
        pre_grasp_distance: how far behind the grasp the straight approach begins; 0: the grasp's pose alone counts [m].
        ik: tolerances and effort.

    Raises:
        InvalidInputError: a number is out of its range.
    """

    robot: str
    samples: int = 20000
    seed: int = 0
    gripper: Gripper = field(default_factory=Gripper)
    half_side: float = 0.2
    heights: tuple[float, float] = (0.01, 0.15)
    pre_grasp_distance: float = 0.1
    ik: IKConfig = field(default_factory=IKConfig)

    def __post_init__(self) -> None:
        get_robot(self.robot)
        check_range("samples", self.samples, 1, 100_000_000)
        check_range("seed", self.seed, 0, 2**31 - 1)
        check_range("half_side", self.half_side, 0.0, 0.5 * TABLE_SIDE, "m")
        check_range("pre_grasp_distance", self.pre_grasp_distance, 0.0, 1.0, "m")
        low, high = self.heights
        if not 0.0 <= low <= high <= 1.0:
            raise InvalidInputError(f"heights are (least, greatest) in [0, 1] m, got {self.heights}")


class ReachSamples(NamedTuple):
    """Which of N poses were reached."""

    vertical_score: Array
    """(N,) s_v."""
    reached: NDArray[np.bool_]
    """(N,)"""
    counts: dict[str, int]
    """How many were reached, and why the others were not."""


def work_table() -> Box:
    """The table that robots work at."""
    return default_table(side=TABLE_SIDE)


def sample_poses(settings: ReachSettings, count: int, rng: np.random.Generator) -> Array:
    """(count, 4, 4) poses T_world_grasp of the documented distribution."""
    table = work_table()
    middle = 0.5 * (np.array(table.lower) + table.upper)[:2]
    tips = np.empty((count, 3))
    tips[:, :2] = middle + rng.uniform(-settings.half_side, settings.half_side, (count, 2))
    tips[:, 2] = table.upper[2] + rng.uniform(*settings.heights, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = tips - settings.gripper.depth * poses[:, :3, 0]
    return poses


def sample_reach(
    settings: ReachSettings, executor: Executor, progress: Callable[[int, int], None] = lambda done, total: None
) -> ReachSamples:
    """Draw all poses and try to reach them, spread over the executor's workers; the seed decides the result.

    Raises:
        ModelError: the robot's model is not installed.
    """
    _arm(settings)  # what is missing is found here, and not in a worker
    pieces = tuple(range(-(-settings.samples // _CHUNK)))
    found: dict[int, tuple[Array, list[str]]] = {}
    progress(0, settings.samples)
    for piece, result in executor.run(try_poses, settings, pieces):
        found[piece] = result
        progress(min(len(found) * _CHUNK, settings.samples), settings.samples)
    outcomes = [outcome for piece in pieces for outcome in found[piece][1]]
    return ReachSamples(
        np.concatenate([found[piece][0] for piece in pieces]),
        np.array([outcome == REACHED for outcome in outcomes]),
        dict(Counter(outcomes).most_common()),
    )


def try_poses(settings: ReachSettings, piece: int) -> tuple[Array, list[str]]:
    """Vertical scores and outcomes of one piece of the poses."""
    count = min(_CHUNK, settings.samples - piece * _CHUNK)
    poses = sample_poses(settings, count, np.random.default_rng([settings.seed, piece]))
    arm = _arm(settings)
    return vertical_score(poses[:, :3, :3]), [reach_outcome(arm, pose, settings.pre_grasp_distance) for pose in poses]


def reach_outcome(arm: ArmKinematics, T_world_grasp: Array, pre_grasp_distance: float) -> str:
    """Whether the arm brings the hand to the pre-grasp and the grasp, or why not."""
    grasp = arm.solve(T_world_grasp)
    if not grasp.success:
        return IN_COLLISION if grasp.obstacle else OUT_OF_REACH
    if pre_grasp_distance == 0.0:
        return REACHED
    # The same of the two orientations of the jaw: the hand does not turn between the two.
    before = pre_grasp_poses(arm.forward(grasp.q)[None], pre_grasp_distance)[0]
    return REACHED if arm.solve(before, near=grasp.q, symmetric=False).success else NO_PRE_GRASP


@lru_cache(maxsize=2)
def _cached_arm(robot: str, gripper: Gripper, ik: IKConfig) -> ArmKinematics:
    return ArmKinematics(get_robot(robot), gripper, work_table(), config=ik)


def _arm(settings: ReachSettings) -> ArmKinematics:
    return _cached_arm(settings.robot, settings.gripper, settings.ik)


def describe(settings: ReachSettings) -> dict[str, Any]:
    """The settings as plain values, for a policy file."""
    return {
        "samples": settings.samples,
        "seed": settings.seed,
        "gripper_width": settings.gripper.width,
        "fingertips": f"within {settings.half_side:g} m of the table's middle in x and y, "
        f"{settings.heights[0]:g} to {settings.heights[1]:g} m above it",
        "orientations": "uniform",
        "pre_grasp_distance": settings.pre_grasp_distance,
    }
