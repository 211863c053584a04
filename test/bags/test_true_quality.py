"""What the models promise on the recordings, judged on the true meshes that they never see."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from regnet_core import GraspDetector, Grasps, Gripper
from regnet_core.data.scenes.scene import Scene
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.io.bags import BagCloud, read_bag_clouds

BAGS = Path(__file__).resolve().parents[2] / "bags"
CLUTTER = ("clutter_10", "clutter_20")


@cache
def truth(name: str) -> GroundTruth:
    scene = Scene.load(BAGS / name / "scene.glb")
    return GroundTruth(scene.world_meshes(), scene.table)


@cache
def clouds(name: str) -> tuple[BagCloud, ...]:
    return tuple(read_bag_clouds(BAGS / name))


@cache
def detected(name: str, width: float, points: int = 0, model: str = "antipodal") -> tuple[Grasps, ...]:
    detector, gripper = GraspDetector(model, seed=0), Gripper(width=width)
    rng = np.random.default_rng(0)
    chosen = [rng.permutation(len(c.points))[: points or None] for c in clouds(name)]
    pairs = zip(clouds(name), chosen, strict=True)
    return tuple(detector.detect(cloud.points[rows], gripper).grasps for cloud, rows in pairs)


def share_free(width: float, points: int = 0, model: str = "antipodal") -> float:
    """Mean over the clouds of the share of the 100 best grasps that touch nothing."""
    gripper = Gripper(width=width)
    every = [(truth(name), grasps[:100]) for name in CLUTTER for grasps in detected(name, width, points, model)]
    free = [1 - judge.collides(grasps, gripper).mean() for judge, grasps in every]
    return float(np.mean(free))


def mean_score(width: float, points: int = 0, model: str = "antipodal") -> float:
    """Mean over the clouds of the true antipodal score of the 100 best grasps, colliding ones included."""
    gripper = Gripper(width=width)
    every = [(truth(name), grasps[:100]) for name in CLUTTER for grasps in detected(name, width, points, model)]
    scores = [judge.antipodal(grasps, gripper).score.mean() for judge, grasps in every]
    return float(np.mean(scores))


@pytest.mark.parametrize(("width", "points"), [(0.08, 0), (0.08, 25600), (0.04, 0), (0.12, 0)])
def test_the_best_grasps_are_free_and_antipodal(width: float, points: int) -> None:
    assert min(len(g) for n in CLUTTER for g in detected(n, width, points)) >= 100
    assert share_free(width, points) >= 0.80
    assert mean_score(width, points) >= 0.70


@pytest.mark.parametrize(("width", "points"), [(0.08, 0), (0.08, 25600), (0.12, 0)])
def test_the_best_grasps_of_the_network_are_free_and_antipodal(width: float, points: int) -> None:
    model = "regnetv2-s"
    assert min(len(g) for n in CLUTTER for g in detected(n, width, points, model)) >= 200
    assert share_free(width, points, model) >= 0.90
    assert mean_score(width, points, model) >= 0.87


@pytest.mark.parametrize("name", CLUTTER)
def test_a_narrow_gripper_closes_on_nothing_wider_than_itself(name: str) -> None:
    gripper = Gripper(width=0.04)
    too_wide = []
    for grasps in detected(name, 0.04):
        contacts = truth(name).antipodal(grasps, gripper)
        assert grasps.width.max() <= 0.04
        assert np.nanmax(contacts.contact_width) <= 0.04
        too_wide.append((truth(name).enclosed_width(grasps[:100], gripper) > 0.04).mean())
    # Where the far side is hidden, many grasps of one object are wrong together: 8 of 100 in one of the clouds.
    assert np.mean(too_wide) <= 0.04 and max(too_wide) <= 0.1


def test_nothing_is_grasped_on_an_empty_table() -> None:
    for model in ("antipodal", "regnetv2-s"):
        assert [len(grasps) for grasps in detected("empty_table", 0.08, model=model)] == [0, 0, 0, 0]


def test_most_objects_are_grasped_from_some_side() -> None:
    gripper = Gripper(width=0.12)
    for name in CLUTTER:
        hit: set[int] = set()
        for grasps in detected(name, 0.12):
            good = grasps[~truth(name).collides(grasps, gripper)]
            hit |= set(truth(name).antipodal(good, gripper).object_index.tolist()) - {-1}
        assert len(hit) >= 0.6 * len(Scene.load(BAGS / name / "scene.glb").objects)
