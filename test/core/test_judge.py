"""The judge of a network's own proposals: against the independent judge, and labels for widths in between."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from regnet_core.data.labels.candidates import CandidateConfig, object_candidates
from regnet_core.data.labels.judge import NOBODY, SceneJudge
from regnet_core.data.labels.narrowing import confidence_between, fitting, kept_share
from regnet_core.data.labels.scene_labels import GraspLabels, SceneLabeller
from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.geometry import Box
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.ops.triangle_tree import build_tree

WIDE = Gripper(width=0.12)
WALL = Box((-0.1, -0.05, 0.75), (-0.09, 0.05, 0.83))


@pytest.fixture(scope="module")
def scene() -> Scene:
    sizes = ((0.05, 0.03, 0.1), (0.03, 0.04, 0.06))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, :3, 3], poses[1, :3, 3] = (0.0, 0.0, 0.8), (0.075, 0.02, 0.78)
    models = tuple(
        ObjectModel(str(i), "box", {}, trimesh.creation.box(size), (9, 9, 9), 500.0, 0.5)
        for i, size in enumerate(sizes)
    )
    return Scene(models, poses, default_table(), (WALL,))


@pytest.fixture(scope="module")
def labels(scene: Scene) -> GraspLabels:
    rng = np.random.default_rng(3)
    own = [object_candidates(m.mesh, (WIDE,), rng, CandidateConfig(points=300))[0] for m in scene.objects]
    return SceneLabeller(scene).label(own, WIDE, rng).kept


def _judge(scene: Scene, clearance: float = 0.0) -> SceneJudge:
    trees = [build_tree(model.mesh.vertices, model.mesh.faces) for model in scene.objects]
    return SceneJudge(trees, scene.poses, scene.table_height, scene.fixtures, clearance)


def test_labels_are_judged_as_they_were_labelled(scene: Scene, labels: GraspLabels) -> None:
    judged = _judge(scene, 0.001).judge(labels.rotation, labels.translation, WIDE)
    assert len(labels) > 100 and judged.free.all()
    np.testing.assert_allclose(judged.score, labels.score, atol=1e-6)
    np.testing.assert_array_equal(judged.object_index, labels.object_index)


def test_shifted_and_turned_hands_are_judged_as_by_rays_and_fcl(scene: Scene, labels: GraspLabels) -> None:
    rng = np.random.default_rng(5)
    rows = rng.choice(len(labels), 400)
    rotation = Rotation.from_rotvec(0.3 * rng.normal(size=(400, 3))).as_matrix() @ labels.rotation[rows]
    translation = labels.translation[rows] + 0.012 * rng.normal(size=(400, 3))
    judged = _judge(scene).judge(rotation, translation, WIDE)
    truth = GroundTruth(scene.world_meshes(), scene.table, fixtures=scene.fixtures)
    hands = Grasps.from_poses(rotation, translation, np.full(400, 0.12), np.zeros(400))
    collides = truth.collides(hands, WIDE)
    assert 60 < collides.sum() < 340
    np.testing.assert_array_equal(judged.free, ~collides)
    rays = np.where(collides, 0.0, truth.antipodal(hands, WIDE).score)
    # Askew on a box, a pad meets an edge: what normal that has depends on where rays 2 mm apart happen to hit.
    difference = np.abs(judged.score - rays)
    assert np.median(difference) < 0.005 and np.mean(difference < 0.1) > 0.9
    assert np.all(judged.score[judged.object_index == NOBODY] == 0.0)


def test_clearance_forbids_what_nearly_touches(scene: Scene) -> None:
    hand = Gripper(width=0.05 + 0.001)  # the first box is 5 cm across along x
    rotation = np.array([[[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]])
    above = np.array([[0.0, 0.0, 0.88]])
    loose, strict = (_judge(scene, gap).judge(rotation, above, hand) for gap in (0.0, 0.001))
    assert loose.free[0] and loose.score[0] == pytest.approx(1.0) and loose.object_index[0] == 0
    assert not strict.free[0] and strict.score[0] == 0.0


def test_two_objects_between_the_fingers_are_no_grasp(scene: Scene) -> None:
    rotation = np.array([[[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]])
    both = _judge(scene).judge(rotation, np.array([[0.035, 0.01, 0.86]]), Gripper(width=0.15))
    assert both.free[0] and both.score[0] == 0.0 and both.object_index[0] == NOBODY


@pytest.mark.parametrize("width", [0.07, 0.045])
def test_grasps_that_fit_a_narrower_jaw_are_as_good_with_it(scene: Scene, labels: GraspLabels, width: float) -> None:
    kept = fitting(labels, width)
    assert 0 < kept.sum() < len(labels)
    some = labels[kept]
    judged = _judge(scene).judge(some.rotation, some.translation, Gripper(width=width))
    assert judged.free.all()
    np.testing.assert_allclose(judged.score, some.score, atol=1e-6)


def test_the_kept_share_is_counted_for_each_object(labels: GraspLabels) -> None:
    kept = labels.object_index == 1
    np.testing.assert_array_equal(kept_share(labels, kept, 4), [0.0, 1.0, 0.0, 0.0])
    np.testing.assert_array_equal(kept_share(labels[:0], kept[:0], 2), [0.0, 0.0])


def test_confidence_goes_over_from_one_width_to_the_next() -> None:
    wide, narrow = np.float32([0.8, 0.0]), np.float32([0.4, 0.2])
    np.testing.assert_allclose(confidence_between(wide, narrow, 0.25), [0.7, 0.05], rtol=1e-6)
