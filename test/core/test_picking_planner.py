"""Which of a detector's grasps is tried: what the camera could not see, the bin, the way in, and earlier failures."""

from types import SimpleNamespace

import numpy as np
import pytest

from regnet_core.data.cameras.camera import Camera, Intrinsics
from regnet_core.geometry import Array
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.picking.observation import Observation
from regnet_core.picking.planner import GraspPlanner, PlanConfig, hidden_share
from regnet_core.picking.workcell import bin_workcell
from regnet_core.policy import make_policy

GRIPPER = Gripper(width=0.08)
DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Columns: approach -z, closing +y, their cross product +x."""
BIN = bin_workcell()
FLOOR = BIN.pick_bin.inside.lower[2] if BIN.pick_bin else 0.0
WAY = 0.10


def _camera(height: float) -> Camera:
    """Looking straight down from above the origin."""
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[2, 3] = height
    return Camera(Intrinsics(200, 200, 200.0, 200.0, 99.5, 99.5), pose)


def _observation(depth: float = np.nan, points: Array | None = None, height: float = 2.0) -> Observation:
    cloud = np.full((1, 3), 9.0) if points is None else points
    return Observation(cloud, _camera(height), np.full((200, 200), depth))


def _grasps(*centres: tuple[float, float, float], quality: float | list[float] = 0.9) -> Grasps:
    n = len(centres)
    return Grasps.from_poses(
        np.tile(DOWN, (n, 1, 1)),
        np.array(centres).reshape(n, 3),
        np.full(n, 0.08),
        np.broadcast_to(quality, n).astype(float),
        np.ones(n),
    )


def _planner(grasps: Grasps, **config: object) -> GraspPlanner:
    """One whose detector always finds these."""
    report = SimpleNamespace(total_seconds=0.25, reason="" if len(grasps) else "nothing there")
    detector = SimpleNamespace(detect=lambda *_, **__: SimpleNamespace(grasps=grasps, report=report))
    return GraspPlanner(detector, make_policy("heuristic"), GRIPPER, BIN, PlanConfig(**config), WAY)  # type: ignore[arg-type]


def test_points_behind_the_seen_surface_are_hidden() -> None:
    points = np.array([[0.0, 0.0, 1.2], [0.0, 0.0, 0.995], [0.0, 0.0, 0.8], [5.0, 0.0, 0.8]])
    seen = _observation(depth=1.0)  # from z = 2 m it sees a surface at z = 1 m
    assert seen.hidden(points).tolist() == [False, False, True, False]  # 5 mm behind is noise, 5 m aside out of sight
    assert not _observation().hidden(points).any()  # no depth is known


@pytest.mark.parametrize(
    ("surface", "share"),
    [(0.5, 0.0), (0.8, 1.0), (0.7 - GRIPPER.depth * 0.625, 0.5)],
    ids=["far below", "above the hand", "half way down the fingers"],
)
def test_share_of_the_fingers_that_is_hidden(surface: float, share: float) -> None:
    # The palm is at 0.7 m; six places along a finger, from a quarter of its depth on to its tip.
    found = hidden_share(_grasps((0.0, 0.0, 0.7)), GRIPPER, _observation(depth=2.0 - surface - 0.01))
    assert found == pytest.approx([share])


def test_no_grasps_have_no_share() -> None:
    assert hidden_share(Grasps.empty(), GRIPPER, _observation(depth=1.0)).shape == (0,)


def test_nothing_is_planned_where_nothing_was_detected() -> None:
    plan = _planner(Grasps.empty()).plan(_observation())
    assert (len(plan.grasp), plan.found, plan.reason, plan.seconds) == (0, 0, "nothing there", 0.25)


def test_best_grasp_whose_way_is_free() -> None:
    high = FLOOR + 0.08
    at_the_wall = BIN.source.upper[1] - 0.03
    grasps = _grasps((0.0, at_the_wall, high), (0.1, 0.0, high), (0.0, 0.0, high), quality=[0.9, 0.8, 0.7])
    pole = np.array([0.1, 0.0, high + GRIPPER.depth]) + np.linspace([0, 0, 0.02], [0, 0, 0.1], 40)
    seen = _observation(points=pole)
    plan = _planner(grasps).plan(seen)
    assert np.allclose(plan.grasp.translation, [[0.0, 0.0, high]])  # the first meets a wall, the second the pole
    assert plan.found == 1
    assert np.allclose(_planner(grasps, check_way=False).plan(seen).grasp.translation, [[0.1, 0.0, high]])
    free_of_walls = _planner(grasps, check_way=False, known_bin=False).plan(seen)
    assert np.allclose(free_of_walls.grasp.translation, [[0.0, at_the_wall, high]])


def test_no_way_in_is_free() -> None:
    grasps = _grasps((0.0, BIN.source.upper[1] - 0.03, FLOOR + 0.08))
    plan = _planner(grasps).plan(_observation())
    assert len(plan.grasp) == 0 and plan.found == 0
    assert plan.reason == "on their way in, the hands of all 1 grasps would meet the bin or the observed cloud"


def test_grasps_of_too_little_quality_are_no_grasps() -> None:
    high = FLOOR + 0.08
    grasps = _grasps((0.0, 0.0, high), (0.1, 0.0, high), quality=[0.6, 0.5])
    planner = _planner(grasps, check_way=False, min_quality=0.45, retry_trust=0.7)
    assert planner.plan(_observation()).found == 2
    planner.learn(grasps[:1], success=False)
    assert planner.plan(_observation()).grasp.translation[0, 0] == pytest.approx(0.1)  # 0.6 * 0.7 < 0.45
    planner.learn(grasps[1:], success=False)
    plan = planner.plan(_observation())
    assert len(plan.grasp) == 0
    assert plan.reason == "the best of 2 grasps has a quality of 0.42, doubts included, less than 0.45"


def test_grasps_near_a_failed_one_are_doubted_until_one_there_succeeds() -> None:
    high = FLOOR + 0.08
    grasps = _grasps((0.0, 0.0, high), (0.1, 0.0, high), quality=[0.9, 0.7])
    planner = _planner(grasps, check_way=False, avoid=0.03, retry_trust=0.7)
    assert planner.plan(_observation()).grasp.translation[0, 0] == 0.0
    planner.learn(grasps[:1], success=False)
    assert planner.plan(_observation()).grasp.translation[0, 0] == pytest.approx(0.1)  # 0.9 * 0.7 < 0.7
    planner.learn(grasps[:1], success=True)
    assert planner.plan(_observation()).grasp.translation[0, 0] == 0.0
