"""The random baseline: what it promises, and that it knows nothing more."""

import numpy as np
import pytest
from shapes import box, single_view

from regnet_core.baselines.random_sampler import RandomConfig, RandomSampler
from regnet_core.collision import SceneCollision
from regnet_core.errors import InvalidInputError
from regnet_core.gripper import Gripper
from regnet_core.proposer import Proposer
from regnet_core.report import StepRecorder
from regnet_core.scene import Scene, SceneConfig, prepare_scene

GRIPPER = Gripper(width=0.07)


@pytest.fixture(scope="module")
def scene() -> Scene:
    cloud = single_view(box(0.05, 0.06, 0.10))
    return prepare_scene(cloud, None, SceneConfig(), np.random.default_rng(0), StepRecorder())


def propose(scene: Scene, seed: int = 0, config: RandomConfig | None = None, gripper: Gripper = GRIPPER):  # type: ignore[no-untyped-def]
    sampler: Proposer = RandomSampler(config)
    return sampler.propose(scene, gripper, np.ones(len(scene.objects.points), bool), np.random.default_rng(seed))


def test_hands_are_at_seen_points_and_come_along_the_normal(scene: Scene) -> None:
    found = propose(scene, config=RandomConfig(normal_cone=0.0, min_points=0))
    surface = scene.objects
    assert found.considered == len(found.grasps) == 4000
    seen, normals = surface.points[surface.observed], surface.normals[surface.observed]
    for i in range(0, 4000, 97):
        grasp = found.grasps[i]
        along = (seen - grasp.translation[0]) @ grasp.approach[0]
        off = np.linalg.norm(seen - grasp.translation[0] - along[:, None] * grasp.approach[0], axis=1)
        hit = np.flatnonzero((off < 1e-9) & (normals @ grasp.approach[0] < -1 + 1e-9))
        assert any(0.0 <= along[j] <= GRIPPER.depth - 0.010 for j in hit)


def test_frames_are_rotations_and_the_jaw_is_open(scene: Scene) -> None:
    found = propose(scene).grasps
    product = found.rotation.transpose(0, 2, 1) @ found.rotation
    assert np.abs(product - np.eye(3)).max() < 1e-12
    assert np.linalg.det(found.rotation).min() > 0.999
    assert (found.width == GRIPPER.width).all()
    assert found.quality.min() >= 0 and found.quality.max() <= 1 and found.quality.std() > 0.2


def test_every_hand_has_points_between_its_fingers(scene: Scene) -> None:
    found = propose(scene, config=RandomConfig(min_points=25))
    counts = SceneCollision(scene.objects.points[scene.objects.observed], None).occupancy(found.grasps, GRIPPER).closing
    assert 0 < len(found.grasps) < found.considered and counts.min() >= 25


def test_rolls_are_spread_evenly(scene: Scene) -> None:
    """Approaches from above: the closing directions' angles, modulo the jaw's symmetry, fill all of 180 degrees."""
    found = propose(scene, config=RandomConfig(min_points=0)).grasps
    down = found[found.approach[:, 2] < -0.9]
    angle = np.degrees(np.arctan2(down.closing[:, 1], down.closing[:, 0])) % 180
    share = np.histogram(angle, bins=6, range=(0, 180))[0] / len(angle)
    assert len(down) > 200 and share.min() > 0.11 and share.max() < 0.23


def test_the_same_seed_gives_the_same_grasps(scene: Scene) -> None:
    first, same, other = (propose(scene, seed).grasps for seed in (1, 1, 2))
    assert np.array_equal(first.poses, same.poses) and np.array_equal(first.quality, same.quality)
    assert first.poses.shape != other.poses.shape or not np.array_equal(first.poses, other.poses)


def test_only_the_focus_is_sampled(scene: Scene) -> None:
    focus = np.zeros(len(scene.objects.points), bool)
    rng = np.random.default_rng(0)
    assert RandomSampler().propose(scene, GRIPPER, focus, rng).considered == 0
    focus[np.flatnonzero(scene.objects.observed)[:3]] = True
    found = RandomSampler(RandomConfig(min_points=0, normal_cone=0.0)).propose(scene, GRIPPER, focus, rng).grasps
    assert len(np.unique(found.approach.round(9), axis=0)) <= 3


def test_a_gripper_shorter_than_the_least_depth_works(scene: Scene) -> None:
    short = Gripper(depth=0.01)
    found = propose(scene, config=RandomConfig(shallowest=0.03, min_points=0), gripper=short).grasps
    assert len(found) and np.isfinite(found.translation).all()


@pytest.mark.parametrize("wrong", [{"samples": 0}, {"normal_cone": -0.1}, {"min_points": -1}])
def test_impossible_numbers_are_refused(wrong: dict) -> None:
    with pytest.raises(InvalidInputError):
        RandomConfig(**wrong)
