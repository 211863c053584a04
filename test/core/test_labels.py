"""Grasp labels: own grasps of an object, what its surroundings leave of them, and point confidence."""

import numpy as np
import pytest
import trimesh

from regnet_core.data.labels.candidates import CandidateConfig, Candidates, object_candidates, resting_directions
from regnet_core.data.labels.confidence import D_TH, grasp_weights, point_confidence
from regnet_core.data.labels.scene_labels import GraspLabels, LabelConfig, LabelledScene, SceneLabeller
from regnet_core.data.objects.models import ObjectModel, sample_object
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.geometry import Box
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper

FEW = CandidateConfig(points=300)
HANDS = tuple(Gripper(width=width) for width in (0.06, 0.12))


def _box_model(name: str, extents: tuple[float, float, float]) -> ObjectModel:
    return ObjectModel(name, "box", {}, trimesh.creation.box(extents), (200, 10, 10), 500.0, 0.5)


def _at(x: float, y: float, height: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, 0.75 + height / 2
    return pose


def _own(mesh: trimesh.Trimesh, *grippers: Gripper) -> tuple[Candidates, ...]:
    return object_candidates(mesh, grippers, np.random.default_rng(7), FEW)


def _scene(*boxes: tuple[float, float, tuple[float, float, float]], fixtures: tuple[Box, ...] = ()) -> Scene:
    models = tuple(_box_model(f"{i}", extents) for i, (_, _, extents) in enumerate(boxes))
    poses = np.array([_at(x, y, extents[2]) for x, y, extents in boxes])
    return Scene(models, poses, default_table(), fixtures)


def _label(scene: Scene, gripper: Gripper = HANDS[0], config: LabelConfig | None = None, seed: int = 0) -> GraspLabels:
    own = [_own(model.mesh, gripper)[0] for model in scene.objects]
    return SceneLabeller(scene, config).label(own, gripper, np.random.default_rng(seed)).kept


@pytest.fixture(scope="module")
def candidates() -> dict[str, tuple[trimesh.Trimesh, tuple[Candidates, ...]]]:
    meshes = {name: sample_object(np.random.default_rng(4), name).mesh for name in ("box", "cup", "banana")}
    return {
        name: (mesh, object_candidates(mesh, HANDS, np.random.default_rng(0), FEW)) for name, mesh in meshes.items()
    }


@pytest.mark.parametrize("name", ["box", "cup", "banana"])
@pytest.mark.parametrize("w", [0, 1])
def test_own_grasps_are_free_and_score_as_rays_say(candidates: dict, name: str, w: int) -> None:
    mesh, both = candidates[name]
    own, gripper = both[w], HANDS[w]
    assert len(own) > 50
    grasps = Grasps.from_poses(own.rotation, own.translation, np.full(len(own), gripper.width), own.score)
    truth = GroundTruth([mesh], None)
    assert not truth.collides(grasps, gripper).any()
    rays = truth.antipodal(grasps, gripper)
    assert np.all(rays.object_index == 0)
    np.testing.assert_allclose(np.abs(own.high - own.low), rays.contact_width, atol=0.004)
    assert np.median(np.abs(own.score - rays.score)) < 0.02
    assert np.mean(np.abs(own.score - rays.score) < 0.1) > 0.85


def test_own_grasps_keep_their_clearance(candidates: dict) -> None:
    _, both = candidates["box"]
    for own, gripper in zip(both, HANDS, strict=True):
        room = gripper.width / 2 - FEW.clearance + 1e-9
        assert np.all(own.high <= room) and np.all(own.low >= -room) and np.all(own.high > own.low)


def test_most_hands_are_centred_on_what_they_hold(candidates: dict) -> None:
    _, both = candidates["box"]
    off = np.abs(both[1].high + both[1].low)
    assert np.mean(off < 0.001) > 0.6 and np.max(off) > 0.005


def test_the_same_state_gives_the_same_grasps() -> None:
    mesh = trimesh.creation.box((0.03, 0.05, 0.1))
    first, again = (object_candidates(mesh, HANDS, np.random.default_rng(5), FEW) for _ in range(2))
    for a, b in zip(first, again, strict=True):
        for name, values in vars(a).items():
            np.testing.assert_array_equal(values, getattr(b, name))


def test_a_mesh_with_a_hole_is_refused() -> None:
    mesh = trimesh.creation.box((0.03, 0.05, 0.1))
    open_box = trimesh.Trimesh(mesh.vertices, mesh.faces[1:])
    with pytest.raises(InvalidInputError, match="watertight"):
        object_candidates(open_box, HANDS, np.random.default_rng(0), FEW)


def test_a_plate_mostly_lies_flat() -> None:
    plate = trimesh.creation.box((0.2, 0.2, 0.01))
    down = resting_directions(plate, 500, np.random.default_rng(0))
    assert np.mean(np.abs(down[:, 2]) > 0.99) > 0.9


def test_labels_are_free_in_the_whole_scene() -> None:
    walls = (Box((-0.1, 0.06, 0.75), (0.1, 0.07, 0.85)),)
    scene = _scene((0.0, 0.0, (0.05, 0.03, 0.1)), (0.07, 0.02, (0.03, 0.03, 0.06)), fixtures=walls)
    for gripper in HANDS:
        labels = _label(scene, gripper)
        truth = GroundTruth(scene.world_meshes(), scene.table, fixtures=walls)
        grasps = labels.grasps(gripper.width)
        assert len(labels) > 20 and not truth.collides(grasps, gripper).any()
        np.testing.assert_array_equal(truth.antipodal(grasps, gripper).object_index, labels.object_index)


def test_a_neighbour_that_would_be_touched_first_leaves_no_label_across_it() -> None:
    # Two plates of 1 cm with 1 cm between them: a hand of 12 cm that comes from above has both between its fingers.
    alone = _label(_scene((0.0, 0.0, (0.1, 0.01, 0.05))), HANDS[1])
    both = _label(_scene((0.0, 0.0, (0.1, 0.01, 0.05)), (0.0, 0.02, (0.1, 0.01, 0.05))), HANDS[1])
    across = np.abs(alone.rotation[:, 1, 1]) > 0.95
    assert across.sum() > 20
    squeezing = (np.abs(both.rotation[:, 1, 1]) > 0.95) & (np.abs(both.contacts[:, 1] - both.contacts[:, 0]) < 0.02)
    assert not squeezing.any()


def test_no_label_comes_from_below_or_reaches_into_the_table() -> None:
    labels = _label(_scene((0.0, 0.0, (0.05, 0.03, 0.1))))
    assert np.all(labels.rotation[:, 2, 0] <= LabelConfig().steepest_rise)
    tips = labels.translation + HANDS[0].depth * labels.rotation[:, :, 0]
    assert np.all(tips[:, 2] > 0.75 + LabelConfig().clearance)


def test_contacts_lie_on_the_faces_of_a_box() -> None:
    labels = _label(_scene((0.0, 0.0, (0.05, 0.03, 0.1))))
    flat = np.abs(labels.rotation[:, 1, 1]) > 0.9999
    assert flat.sum() > 5
    y = labels.translation[flat, 1:2] + labels.contacts[flat] * labels.rotation[flat, 1, 1][:, None]
    np.testing.assert_allclose(np.sort(y, axis=1), [[-0.015, 0.015]] * flat.sum(), atol=5e-4)
    np.testing.assert_allclose(labels.score[flat], 1.0, atol=1e-3)


def test_rotations_are_canonical_and_centre_scores_hand_computed() -> None:
    labels = _label(_scene((0.0, 0.0, (0.05, 0.03, 0.1))))
    assert np.all(labels.rotation[:, 0, 1] >= 0.0)
    np.testing.assert_allclose(np.linalg.det(labels.rotation), 1.0, atol=1e-9)
    one = GraspLabels(
        np.zeros((1, 3)), np.eye(3)[None], np.ones(1), np.array([[-0.01, 0.02]]), np.zeros(1), np.zeros(1, int)
    )
    assert one.centre_score(0.08)[0] == pytest.approx(1.0 - 0.005 / 0.04)


def test_thinning_keeps_the_best_grasp_of_each_point() -> None:
    scene = _scene((0.0, 0.0, (0.05, 0.03, 0.1)))
    own = [_own(model.mesh, HANDS[0])[0] for model in scene.objects]

    def label(**values: int) -> LabelledScene:
        return SceneLabeller(scene, LabelConfig(**values)).label(own, HANDS[0], np.random.default_rng(0))

    labelled = label(per_point=1)
    assert len(labelled.kept) == min(len(labelled.best), 300)
    assert labelled.found > len(labelled.best) > 30
    everything = label(per_point=99, per_object=99999)
    assert len(everything.kept) == labelled.found
    assert labelled.best.score.mean() > everything.kept.score.mean()
    assert labelled.best.score.max() == everything.kept.score.max()
    few = label(per_object=10)
    assert len(few.kept) == 10


def test_an_empty_table_has_no_labels() -> None:
    labels = _label(Scene((), np.zeros((0, 4, 4)), default_table()))
    assert len(labels) == 0 and labels.grasps(0.06).rotation.shape == (0, 3, 3)


def test_confidence_is_the_tanh_of_a_brute_force_sum() -> None:
    rng = np.random.default_rng(0)
    points, entries, scores = rng.uniform(0, 0.1, (700, 3)), rng.uniform(0, 0.1, (900, 3)), rng.uniform(0, 1, 900)
    near = np.linalg.norm(points[:, None] - entries[None], axis=2) < D_TH
    np.testing.assert_allclose(point_confidence(points, entries, scores), np.tanh(near @ scores), atol=1e-12)
    assert 0.0 < np.mean(near.any(axis=1)) < 1.0


def test_confidence_without_grasps_or_points() -> None:
    np.testing.assert_array_equal(point_confidence(np.ones((3, 3)), np.zeros((0, 3)), np.zeros(0)), np.zeros(3))
    assert point_confidence(np.zeros((0, 3)), np.ones((2, 3)), np.ones(2)).shape == (0,)


def test_weights_make_the_sum_a_mean_over_the_surface() -> None:
    # A plane of 0.2 m x 0.2 m with one grasp of score 0.5 at each of its sampled points: the mean is 0.5.
    rng = np.random.default_rng(1)
    count = 40000
    entries = np.column_stack([rng.uniform(-0.1, 0.1, (count, 2)), np.zeros(count)])
    weight = grasp_weights(np.array([0.04]), count, 1.0)[0]
    middle = point_confidence(np.zeros((1, 3)), entries, np.full(count, 0.5 * weight))
    assert np.arctanh(middle[0]) == pytest.approx(0.5, rel=0.15)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"points": 0}, "points must be in"),
        ({"rolled": 1.5}, "rolled must be in"),
        ({"clearance": -1.0}, "clearance must be"),
    ],
)
def test_wrong_settings_are_refused(values: dict[str, float], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        CandidateConfig(**values)  # type: ignore[arg-type]


def test_wider_hands_find_more_on_a_wide_object() -> None:
    scene = _scene((0.0, 0.0, (0.07, 0.09, 0.1)))
    own = _own(scene.objects[0].mesh, *HANDS)
    rng = np.random.default_rng(0)
    counts = [SceneLabeller(scene).label([c], hand, rng).found for hand, c in zip(HANDS, own, strict=True)]
    assert counts[0] < 100 < counts[1]
