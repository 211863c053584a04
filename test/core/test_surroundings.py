"""Objects on a table in a room: floors, walls, people, shelves and crates must not spoil the grasps."""

import numpy as np
import pytest
import shapes
import trimesh

from regnet_core import Box, GraspDetector, Gripper
from regnet_core.clusters import beyond, cluster, structure
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.support_plane import fit_support_plane

OBJECT = shapes.single_view(shapes.box(0.05, 0.12, 0.10), side=0.8)
MESH = trimesh.creation.box((0.05, 0.12, 0.10)).apply_translation((0, 0, 0.80))
TABLE = Box((-0.5, -0.5, 0.70), (0.5, 0.5, 0.75))


def plate(
    lower: tuple[float, float, float], upper: tuple[float, float, float], count: int, seed: int = 0
) -> np.ndarray:
    """Noisy points of a flat rectangle, given by two corners that agree in one coordinate."""
    rng = np.random.default_rng(seed)
    return rng.uniform(lower, upper, (count, 3)) + rng.normal(0, 0.001, (count, 3))


FLOOR = plate((-1.5, -1.5, 0.0), (-0.45, 1.5, 0.0), 30000)
SURROUNDINGS = {
    "floor": FLOOR,
    "wall behind the table": np.concatenate([FLOOR, plate((-1.5, -1.5, 0.0), (-1.5, 1.5, 2.2), 40000)]),
    "wall at the table": plate((-0.42, -1.0, 0.0), (-0.42, 1.0, 2.0), 40000),
    "person": plate((-0.6, 0.1, 0.3), (-0.6, 0.6, 1.8), 12000),
    "shelf above": plate((-0.4, -0.4, 1.45), (0.0, 0.4, 1.45), 8000),
    "cabinet": np.concatenate(
        [plate((-0.9, -0.4, 0.95), (-0.45, 0.4, 0.95), 9000), plate((-0.45, -0.4, 0.0), (-0.45, 0.4, 0.95), 9000)]
    ),
    "stray points far away": np.array([[900.0, 900.0, 5.0], [-900.0, 30.0, 2.0], [3.0, 900.0, -900.0]]),
}


@pytest.mark.parametrize("name", SURROUNDINGS)
def test_the_object_is_grasped_as_if_it_were_alone(name: str) -> None:
    alone = GraspDetector("antipodal").detect(OBJECT)
    result = GraspDetector("antipodal").detect(np.concatenate([OBJECT, SURROUNDINGS[name]]))
    assert result.plane is not None
    assert result.plane.offset == pytest.approx(0.75, abs=2e-3)
    best = result.grasps[:50]
    assert len(result.grasps) > 0.15 * len(alone.grasps)
    assert np.linalg.norm(best.fingertips(Gripper())[:, :2], axis=1).max() < 0.12
    assert GroundTruth([MESH], TABLE).collides(best, Gripper()).mean() <= 0.1


def test_a_wall_is_still_an_obstacle() -> None:
    close = plate((-0.06, -0.4, 0.75), (-0.06, 0.4, 1.8), 60000)
    mesh = trimesh.creation.box((0.02, 0.8, 1.05)).apply_translation((-0.07, 0.0, 1.275))
    truth = GroundTruth([mesh], None)
    freely = GraspDetector("antipodal").detect(OBJECT).grasps
    beside = GraspDetector("antipodal").detect(np.concatenate([OBJECT, close])).grasps
    assert truth.collides(freely, Gripper()).mean() > 0.2
    assert truth.collides(beside, Gripper()).mean() < 0.02


@pytest.mark.parametrize("size", [(0.25, 0.25, 0.2), (0.32, 0.32, 0.2), (0.4, 0.3, 0.1)])
def test_the_lid_of_a_crate_is_no_support_plane(size: tuple[float, float, float]) -> None:
    crate = shapes.single_view(shapes.box(*size), side=1.0)
    points = np.concatenate([crate, OBJECT[OBJECT[:, 2] > 0.76] + [0.3, 0.3, 0.0]])
    plane = fit_support_plane(points, np.random.default_rng(0))
    assert plane is not None
    assert plane.offset == pytest.approx(0.75, abs=2e-3)


@pytest.mark.parametrize("height", [0.45, 0.6, 0.9])
def test_slender_objects_of_any_height_are_grasped(height: float) -> None:
    camera = np.array([0.8, 0.0, 0.75 + height + 0.5])
    post = shapes.single_view(shapes.box(0.05, 0.05, height, density=2e4), camera=camera)
    mesh = trimesh.creation.box((0.05, 0.05, height)).apply_translation((0, 0, 0.75 + height / 2))
    best = [GraspDetector("antipodal", seed=seed).detect(post).grasps[:50] for seed in range(4)]
    assert [len(grasps) for grasps in best] == [50] * 4
    assert np.mean([GroundTruth([mesh], TABLE).collides(grasps, Gripper()) for grasps in best]) <= 0.15


def test_planes_that_tilt_too_much_are_no_support() -> None:
    rng = np.random.default_rng(0)
    strip = np.column_stack([rng.uniform(-0.5, 0.5, 3000), rng.normal(0, 5e-4, 3000), rng.uniform(0, 0.015, 3000)])
    plane = fit_support_plane(strip, rng)
    assert plane is None or plane.normal[2] > np.cos(np.radians(15))


def test_clusters_are_connected_from_above() -> None:
    points = np.array([[0.005, 0.005, 0], [0.025, 0.025, 1], [0.1, 0.1, 0], [0.115, 0.1, 5], [-900.0, 900.0, 0]])
    groups = cluster(points, cell=0.02)
    assert len(groups.size) == 3
    assert groups.label[0] == groups.label[1]
    assert groups.label[2] == groups.label[3] != groups.label[0]
    assert groups.extent(points)[groups.label[2]] == pytest.approx(0.015)
    assert groups.mean(points)[groups.label[0]] == pytest.approx((0.015, 0.015, 0.5))
    assert len(cluster(np.zeros((0, 3))).size) == 0


def test_structure_is_tall_and_wide_and_ends_at_a_gap() -> None:
    wall = plate((0.0, 0.0, 0.0), (0.0, 1.0, 1.0), 20000)
    post = plate((1.0, 0.0, 0.0), (1.0, 0.05, 1.0), 3000)
    low = plate((2.0, 0.0, 0.0), (2.0, 1.0, 0.4), 5000)
    shelf = plate((3.0, 0.0, 0.9), (3.4, 1.0, 0.9), 9000)
    under = plate((3.1, 0.4, 0.0), (3.2, 0.5, 0.0), 500)
    points = np.concatenate([wall, post, low, shelf, under])
    marked = structure(points, points[:, 2], max_height=0.5)
    parts = np.split(marked, np.cumsum([len(wall), len(post), len(low), len(shelf)]))
    assert [part.mean().round(2) for part in parts] == [1.0, 0.0, 0.0, 1.0, 0.0]


def test_wide_things_beside_the_ground_are_beyond_it() -> None:
    ground = plate((0.0, 0.0, 0.0), (1.0, 1.0, 0.0), 4000)
    inside = plate((0.2, 0.2, 0.1), (0.9, 0.9, 0.1), 2000)
    beside = plate((1.3, 0.0, 0.0), (1.3, 1.0, 0.3), 2000)
    small = plate((1.3, -0.5, 0.0), (1.3, -0.3, 0.3), 500)
    marked = beyond(np.concatenate([inside, beside, small]), ground)
    assert (marked[:2000].any(), marked[2000:4000].all(), marked[4000:].any()) == (False, True, False)
    assert not beyond(inside, ground[:2]).any()
