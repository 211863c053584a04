"""GraspDetector on objects of known size, with the model antipodal: order, limits, reasons, reproducibility."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import shapes
import torch
import trimesh

from regnet_core import (
    Box,
    CloudError,
    Detection,
    DetectorConfig,
    GraspDetector,
    GraspFilters,
    Gripper,
    InvalidInputError,
)
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.scene import SceneConfig

BOX = shapes.single_view(shapes.box(0.05, 0.12, 0.10))
CYLINDER = shapes.single_view(shapes.cylinder(0.03, 0.12))
BALL = shapes.single_view(shapes.sphere(0.03))


def moved(points: np.ndarray, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    return points + np.array([x, y, 0.0])


def detect(points: np.ndarray, width: float = 0.08, **settings: object) -> Detection:
    return GraspDetector("antipodal", seed=0).detect(points, Gripper(width=width), **settings)


BOX_MESH = trimesh.creation.box((0.05, 0.12, 0.10)).apply_translation((0, 0, 0.80))
CYLINDER_MESH = trimesh.creation.cylinder(0.03, 0.12, sections=128).apply_translation((0, 0, 0.81))
BALL_MESH = trimesh.creation.icosphere(5, 0.03).apply_translation((0, 0, 0.78))
TABLE_BOX = Box((-0.5, -0.5, 0.70), (0.5, 0.5, 0.75))


@pytest.mark.parametrize(
    ("points", "mesh"), [(BOX, BOX_MESH), (CYLINDER, CYLINDER_MESH), (BALL, BALL_MESH)], ids=["box", "cylinder", "ball"]
)
def test_the_best_grasps_are_good_on_the_true_object(points: np.ndarray, mesh: trimesh.Trimesh) -> None:
    best = detect(points).grasps[:50]
    truth = GroundTruth([mesh], TABLE_BOX)
    assert len(best) == 50
    assert truth.collides(best, Gripper()).mean() <= 0.1
    contacts = truth.antipodal(best, Gripper())
    assert contacts.score.mean() > 0.8
    # The sampler does not promise more than the object gives.
    assert np.median(contacts.score - best.quality) > -0.02


def test_a_box_is_grasped_across_its_narrow_side() -> None:
    best = detect(BOX).grasps[:50]
    assert np.mean(np.abs(best.closing[:, 0]) > 0.95) > 0.6
    # The jaw is centred on the box and open wider than it.
    assert np.median(np.abs(best.fingertips(Gripper())[:, 0])) < 0.003
    assert best.width.min() > 0.05


def test_a_box_wider_than_the_gripper_is_left_alone() -> None:
    wide = shapes.single_view(shapes.box(0.07, 0.12, 0.10))
    assert len(detect(wide, 0.08).grasps) > 20
    # Only its corners fit a jaw of 50 mm; faces at right angles give at most cos(45 deg)^2 = 0.5.
    corners = detect(wide, 0.05).grasps
    assert len(corners) < 10
    assert (corners.quality < 0.55).all()


@pytest.mark.parametrize("width", [0.03, 0.04, 0.06, 0.08, 0.12, 0.16])
def test_nothing_wider_than_the_gripper_is_proposed(width: float) -> None:
    scene = np.concatenate([moved(BOX, x=0.15), moved(CYLINDER, x=-0.15)])
    grasps = detect(scene, width).grasps
    assert (grasps.width <= width).all()
    assert (grasps.width > 0).all()


def test_the_result_is_ranked_valid_and_canonical() -> None:
    grasps = detect(BOX).grasps
    assert (np.diff(grasps.quality) <= 0).all()
    assert ((grasps.quality >= 0) & (grasps.quality <= 1)).all()
    assert ((grasps.confidence >= 0) & (grasps.confidence <= 1)).all()
    assert np.allclose(np.swapaxes(grasps.rotation, 1, 2) @ grasps.rotation, np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(grasps.rotation), 1.0)
    assert (grasps.closing[:, 0] >= 0).all()


def test_no_part_of_a_hand_is_in_the_table() -> None:
    gripper = Gripper()
    for grasp in detect(BALL).grasps:
        corners = np.concatenate([b.corners() for b in gripper.bodies(float(grasp.width[0]))])
        assert (corners @ grasp.rotation[0].T + grasp.translation[0])[:, 2].min() > shapes.TABLE


def test_the_same_seed_gives_the_same_grasps_and_another_seed_others() -> None:
    detector = GraspDetector("antipodal", seed=3)
    a, b = detector.detect(BOX).grasps, detector.detect(BOX).grasps
    c = GraspDetector("antipodal", seed=4).detect(BOX).grasps
    assert np.array_equal(a.translation, b.translation)
    assert np.array_equal(a.rotation, b.rotation)
    assert not np.array_equal(a.translation[:20], c.translation[:20])


@pytest.mark.parametrize("model", ["antipodal", "regnetv2-s"])
def test_detections_in_several_threads_give_what_each_gives_alone(model: str) -> None:
    detector, widths = GraspDetector(model), [0.05, 0.08, 0.11, 0.08]
    scenes = [np.concatenate([moved(BOX, x=0.1 * i), moved(CYLINDER, x=-0.15)]) for i in (1, 2, 1, 2)]
    threads_of_torch = torch.get_num_threads()
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(lambda i: detector.detect(scenes[i % 4], Gripper(widths[i % 4])).grasps, range(8)))
    for i, grasps in enumerate(together):
        alone = detector.detect(scenes[i % 4], Gripper(widths[i % 4])).grasps
        assert len(alone) > 0
        np.testing.assert_array_equal(grasps.rotation, alone.rotation)
        np.testing.assert_array_equal(grasps.quality, alone.quality)
    assert torch.get_num_threads() == threads_of_torch


def test_the_input_is_not_changed() -> None:
    points = BOX.copy()
    detect(points)
    assert np.array_equal(points, BOX)


def test_float32_and_nan_rows_change_nothing_essential() -> None:
    points = np.concatenate([BOX, np.full((100, 3), np.nan)]).astype(np.float32)
    result = detect(points)
    assert result.report["valid points"].rejected == 100
    assert len(result.grasps) > 50


def test_the_approach_cone() -> None:
    limits = GraspFilters(approach_max_angle=np.radians(20))
    result = detect(BOX, filters=limits)
    assert len(result.grasps) > 0
    assert result.grasps.approach[:, 2].max() <= -np.cos(np.radians(20)) + 1e-9
    assert result.report["approach cone"].rejected > 0


def test_workspace_and_minimum_quality() -> None:
    limits = GraspFilters(workspace=Box((-1, 0.0, 0), (1, 1, 2)), min_quality=0.5)
    grasps = detect(BOX, filters=limits).grasps
    assert len(grasps) > 0
    assert grasps.fingertips(Gripper())[:, 1].min() >= 0.0
    assert grasps.quality.min() >= 0.5


def two_boxes() -> tuple[np.ndarray, np.ndarray]:
    left = shapes.single_view(shapes.box(0.04, 0.08, 0.10), side=0.3)
    points = np.concatenate([moved(left, y=-0.15), moved(left, y=0.15)])
    return points, points[:, 1] > 0


@pytest.mark.parametrize("kind", ["box", "mask"])
def test_only_the_target_is_grasped(kind: str) -> None:
    points, mask = two_boxes()
    target = mask if kind == "mask" else Box((-1, 0, 0), (1, 1, 2))
    grasps = detect(points, filters=GraspFilters(target=target)).grasps
    assert len(grasps) > 20
    assert grasps.fingertips(Gripper())[:, 1].min() > 0.05


def test_the_scene_around_a_target_still_blocks() -> None:
    inner = shapes.single_view(shapes.box(0.04, 0.04, 0.06))
    free = detect(inner, filters=GraspFilters(target=Box((-0.05, -0.05, 0), (0.05, 0.05, 2))))
    along, across = shapes.box(0.02, 0.24, 0.16).points, shapes.box(0.24, 0.02, 0.16).points
    well = [moved(along, x=0.045), moved(along, x=-0.045), moved(across, y=0.045), moved(across, y=-0.045)]
    blocked = np.concatenate([inner, *well])
    shut = detect(blocked, filters=GraspFilters(target=Box((-0.03, -0.03, 0), (0.03, 0.03, 0.82))))
    assert len(free.grasps) > 20
    assert len(shut.grasps) < len(free.grasps) / 10


def test_a_mask_of_every_point_refuses_nothing() -> None:
    everything = detect(BOX, filters=GraspFilters(target=np.ones(len(BOX), bool)))
    assert everything.report["target region"].rejected == 0
    assert np.array_equal(everything.grasps.translation, detect(BOX).grasps.translation)


def test_a_target_without_an_object_says_so() -> None:
    result = detect(BOX, filters=GraspFilters(target=Box((0.2, 0.2, 0), (0.25, 0.25, 2))))
    assert "target region contains no point of an object" in result.report.reason


def test_a_mask_of_the_wrong_length_is_refused() -> None:
    with pytest.raises(CloudError, match="target mask"):
        detect(BOX, filters=GraspFilters(target=np.ones(5, bool)))
    with pytest.raises(CloudError, match="target mask"):
        detect(np.zeros((0, 3)), filters=GraspFilters(target=np.ones(5, bool)))


@pytest.mark.parametrize(
    "wrong",
    [
        {"points": 5.0, "colors": [[0, 0, 0]]},
        {"points": [[0.0, 1.0], [1.0]], "colors": [[0, 0, 0]]},
        {"points": BOX, "colors": [[0, 0, 0], [1]]},
        {"points": BOX, "colors": np.full((len(BOX), 3), 1.5)},
        {"points": BOX, "viewpoint": ["a", "b", "c"]},
        {"points": BOX, "viewpoint": [np.nan, 0.0, 0.0]},
        {"points": BOX, "viewpoint": [1e308, 0.0, 0.0]},
        {"points": BOX, "viewpoint": np.zeros((2, 3))},
        {"points": BOX, "gripper": 0.08},
    ],
)
def test_wrong_arguments_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError):
        GraspDetector("antipodal").detect(**wrong)


@pytest.mark.parametrize("seed", [-1, 1.5, "a", None, True])
def test_wrong_seeds_are_refused(seed: Any) -> None:
    with pytest.raises(InvalidInputError, match="seed must be"):
        GraspDetector("antipodal", seed=seed)


def test_configurations_without_sense_are_refused() -> None:
    for settings in ({"voxel": 0.0}, {"voxel": np.nan}, {"plane_clearance": -1.0}, {"max_points": 0}):
        with pytest.raises(InvalidInputError):
            SceneConfig(**settings)
    with pytest.raises(InvalidInputError, match="max_grasps"):
        DetectorConfig(max_grasps=0)


@pytest.mark.parametrize(
    ("points", "config", "reason"),
    [
        (np.zeros((0, 3)), SceneConfig(), "the cloud is empty"),
        (np.full((40, 3), np.nan), SceneConfig(), "none of the 40 points is valid"),
        (np.array([[0.1, 0.2, 0.8]]), SceneConfig(), "no surface in the cloud, and no support plane"),
        (np.tile([[0.1, 0.2, 0.8]], (500, 1)), SceneConfig(), "surface"),
        (shapes.single_view(None), SceneConfig(), "nothing stands on the support plane"),
        (BOX, SceneConfig(workspace=Box((5, 5, 5), (6, 6, 6))), "lies in the workspace"),
    ],
)
def test_when_there_is_no_grasp_the_report_says_why(points: np.ndarray, config: SceneConfig, reason: str) -> None:
    result = GraspDetector("antipodal", config=DetectorConfig(scene=config)).detect(points)
    assert len(result.grasps) == 0
    assert reason in result.report.reason


def test_the_reason_names_the_filter_that_left_nothing() -> None:
    result = detect(BOX, filters=GraspFilters(workspace=Box((5, 5, 5), (6, 6, 6))))
    assert "workspace" in result.report.reason
    assert result.report["workspace"].kept == 0


def test_the_counts_of_the_steps_add_up() -> None:
    steps = detect(BOX).report.steps
    names = [s.name for s in steps]
    for before, after in zip(steps[names.index("proposals") :], steps[names.index("proposals") + 1 :], strict=False):
        assert before.kept == after.kept + after.rejected
    assert steps[0].kept + steps[0].rejected == len(BOX)
    assert all(s.seconds >= 0 for s in steps)


def test_max_grasps_keeps_the_best() -> None:
    few = GraspDetector("antipodal", config=DetectorConfig(max_grasps=7)).detect(BOX).grasps
    assert np.array_equal(few.quality, detect(BOX).grasps.quality[:7])


def test_a_cloud_without_a_table_is_still_grasped() -> None:
    ball = shapes.sphere(0.03)
    result = detect(ball.points)
    assert result.plane is None
    assert len(result.grasps) > 20
    assert "no support plane" in result.report.warnings[0]


def test_the_seen_side_of_objects_cut_out_of_the_table_is_completed() -> None:
    result = detect(BOX[BOX[:, 2] > 0.765])
    best = result.grasps[:50]
    assert result.plane is None
    assert GroundTruth([BOX_MESH], None).collides(best, Gripper()).mean() <= 0.1


@pytest.mark.parametrize("wrong", [{"min_quality": 1.5}, {"approach_max_angle": 4.0}, {"approach_axis": (0, 0, 0)}])
def test_filters_without_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError):
        GraspFilters(**wrong)
