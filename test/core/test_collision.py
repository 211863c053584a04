"""Collision against an independent computation: every point against every box, in the plainest way."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnet_core import Grasps, Gripper, InvalidInputError, Plane
from regnet_core.collision import CollisionConfig, SceneCollision, lowest_height

TABLE = Plane((0.0, 0.0, 1.0), 0.75)


def random_grasps(count: int, seed: int, gripper: Gripper) -> Grasps:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(count, random_state=seed).as_matrix()
    width = rng.uniform(0.01, gripper.width, count)
    return Grasps.from_poses(rotation, rng.uniform(-0.1, 0.1, (count, 3)), width, np.ones(count))


def brute_force(points: np.ndarray, grasps: Grasps, gripper: Gripper) -> np.ndarray:
    counts = []
    for g in grasps:
        local = (points - g.translation[0]) @ g.rotation[0]
        palm, left, right = (b.contains(local) for b in gripper.bodies(float(g.width[0])))
        closing = gripper.closing_region(float(g.width[0])).contains(local)
        counts.append([palm.sum(), (left | right).sum(), closing.sum()])
    return np.array(counts)


@pytest.mark.parametrize(("seed", "width"), [(0, 0.08), (1, 0.12), (2, 0.03)])
def test_counts_equal_brute_force(seed: int, width: float) -> None:
    gripper = Gripper(width=width)
    points = np.random.default_rng(seed).uniform(-0.2, 0.2, (20000, 3))
    grasps = random_grasps(200, seed, gripper)
    counts = SceneCollision(points, None).occupancy(grasps, gripper)
    expected = brute_force(points, grasps, gripper)
    assert expected.sum(axis=0).min() > 0
    assert np.array_equal(np.column_stack([counts.palm, counts.fingers, counts.closing]), expected)


def test_marked_points_are_those_between_the_fingers() -> None:
    points = np.array([[0.02, 0.0, 0.0], [0.03, 0.01, 0.0], [0.03, 0.045, 0.0]])
    grasp = Grasps.from_poses(np.eye(3)[None], np.zeros((1, 3)), [0.08], [1.0])
    counts = SceneCollision(points, None).occupancy(grasp, Gripper(), marked=np.array([False, True, True]))
    assert (counts.closing[0], counts.marked[0], counts.fingers[0]) == (2, 1, 1)


def test_the_margin_grows_the_hand_outwards_but_not_into_the_jaw() -> None:
    gripper = Gripper(width=0.08)
    grasp = Grasps.from_poses(np.eye(3)[None], np.zeros((1, 3)), [0.08], [1.0])
    outside = np.array([[0.03, 0.0515, 0.0]])
    inside = np.array([[0.03, 0.0395, 0.0]])
    assert SceneCollision(outside, None).occupancy(grasp, gripper).fingers[0] == 0
    assert SceneCollision(outside, None).occupancy(grasp, gripper, margin=0.002).fingers[0] == 1
    assert SceneCollision(inside, None).occupancy(grasp, gripper, margin=0.002).fingers[0] == 0


def test_single_points_are_noise_up_to_the_limit() -> None:
    points = np.array([[-0.01, 0.0, 0.0], [-0.02, 0.0, 0.0]])
    grasp = Grasps.from_poses(np.eye(3)[None], np.zeros((1, 3)), [0.08], [1.0])
    assert SceneCollision(points, None, CollisionConfig(max_points=1)).with_points(grasp, Gripper())[0]
    assert not SceneCollision(points, None, CollisionConfig(max_points=2)).with_points(grasp, Gripper())[0]


@pytest.mark.parametrize("most", [0, 1, 5])
@pytest.mark.parametrize(("count", "spread"), [(150, 0.12), (60_000, 2.0)])
def test_hands_that_hit_points_are_those_with_too_many_in_palm_or_fingers(most: int, count: int, spread: float) -> None:
    gripper = Gripper(width=0.08)
    points = np.random.default_rng(3).uniform(-1.0, 1.0, (count, 3)) * [spread, spread, 0.12]
    grasps, margin = random_grasps(600, 4, gripper), 0.003
    grasps = Grasps.concatenate([grasps, Grasps.from_poses(np.eye(3)[None], [[9.0, 0.0, 0.0]], [0.05], [1.0])])
    scene = SceneCollision(points, None, CollisionConfig(margin=margin, max_points=most))
    counts = scene.occupancy(grasps, gripper, margin=margin)
    expected = (counts.palm > most) | (counts.fingers > most)
    np.testing.assert_array_equal(scene.with_points(grasps, gripper), expected)
    assert 0 < expected.sum() < len(grasps) - 1
    assert not SceneCollision(points[:0], None).with_points(grasps, gripper).any()
    assert scene.with_points(grasps[:0], gripper).shape == (0,)


def test_lowest_height_equals_the_lowest_of_all_corners() -> None:
    gripper = Gripper(width=0.09)
    grasps = random_grasps(300, 5, gripper)
    tilted = Plane((0.6, 0.0, 0.8), 0.1)
    for plane in (TABLE, tilted):
        expected = [
            min(
                plane.height(g.translation[0] + body.corners() @ g.rotation[0].T).min()
                for body in gripper.bodies(float(g.width[0]))
            )
            for g in grasps
        ]
        assert np.allclose(lowest_height(grasps, gripper, plane), expected, atol=1e-12)


@pytest.mark.parametrize(("tip_height", "hits"), [(0.002, True), (0.004, False), (-0.01, True)])
def test_table_by_hand(tip_height: float, hits: bool) -> None:
    down = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    grasp = Grasps.from_poses(down[None], [[0.0, 0.0, 0.75 + 0.06 + tip_height]], [0.05], [1.0])
    scene = SceneCollision(np.zeros((0, 3)), TABLE, CollisionConfig(table_clearance=0.003))
    assert scene.with_table(grasp, Gripper())[0] == hits
    assert not SceneCollision(np.zeros((0, 3)), None).with_table(grasp, Gripper())[0]
    assert not scene.with_points(grasp, Gripper())[0]


@pytest.mark.parametrize("field", ["margin", "max_points", "table_clearance"])
@pytest.mark.parametrize("value", [-1, np.nan, np.inf, "1", None, True])
def test_limits_without_sense_are_refused(field: str, value: object) -> None:
    with pytest.raises(InvalidInputError, match=f"{field} must be a finite number of at least 0"):
        CollisionConfig(**{field: value})
