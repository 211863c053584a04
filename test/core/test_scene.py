"""A prepared scene: the hidden sides of known objects, outward normals, unseen ground."""

import numpy as np
import pytest
import shapes

from regnet_core import Box
from regnet_core.ops import parallel
from regnet_core.pointcloud import voxel_downsample
from regnet_core.report import StepRecorder
from regnet_core.scene import Scene, SceneConfig, prepare_scene
from regnet_core.visibility import unseen_ground


def prepare(points: np.ndarray, **settings: object) -> tuple[Scene, StepRecorder]:
    recorder = StepRecorder()
    return prepare_scene(points, None, SceneConfig(**settings), np.random.default_rng(0), recorder), recorder


def test_hidden_walls_of_a_box_are_where_they_are() -> None:
    scene, _ = prepare(shapes.single_view(shapes.box(0.06, 0.10, 0.12)))
    hidden = scene.objects.points[~scene.objects.observed]
    back = hidden[(np.abs(hidden[:, 1]) < 0.035) & (hidden[:, 2] > 0.77) & (hidden[:, 2] < 0.85)]
    assert len(back) > 100
    # The camera looks from +x: what it could not see is the side at x = -0.03.
    assert np.median(back[:, 0]) == pytest.approx(-0.03, abs=0.003)
    normals = scene.objects.normals[~scene.objects.observed]
    middle = (hidden[:, 0] < -0.025) & (np.abs(hidden[:, 1]) < 0.03) & (hidden[:, 2] > 0.77) & (hidden[:, 2] < 0.85)
    assert normals[middle].mean(axis=0) == pytest.approx((-1, 0, 0), abs=0.1)


def test_observed_normals_point_out_of_the_object() -> None:
    solid = shapes.cylinder(0.035, 0.12)
    scene, _ = prepare(shapes.single_view(solid))
    p, n = scene.objects.points[scene.objects.observed], scene.objects.normals[scene.objects.observed]
    wall = (p[:, 2] > 0.77) & (p[:, 2] < 0.85)
    outward = p[wall] * [1, 1, 0] / np.linalg.norm(p[wall, :2], axis=1, keepdims=True)
    assert np.mean(np.sum(n[wall] * outward, axis=1) > 0.9) > 0.95
    lid = (p[:, 2] > 0.868) & (np.linalg.norm(p[:, :2], axis=1) < 0.025)
    assert np.mean(n[lid, 2] > 0.9) > 0.95


def test_a_known_viewpoint_orients_the_normals_too() -> None:
    points = shapes.single_view(shapes.sphere(0.04))
    recorder, rng = StepRecorder(), np.random.default_rng(0)
    config = SceneConfig(complete_hidden=False)
    scene = prepare_scene(points, None, config, rng, recorder, viewpoint=shapes.CAMERA)
    towards = shapes.CAMERA - scene.objects.points
    assert (np.sum(scene.objects.normals * towards, axis=1) >= 0).all()
    assert scene.objects.observed.all()


def test_what_was_seen_comes_first_and_nothing_depends_on_the_number_of_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    points = shapes.single_view(shapes.box(0.06, 0.10, 0.12))
    scene, recorder = prepare(points)
    seen = len(scene.seen)
    assert scene.objects.observed[:seen].all() and not scene.objects.observed[seen:].any() and seen > 500
    np.testing.assert_array_equal(scene.objects.points[:seen], scene.seen)
    assert {step.name: step.kept for step in recorder.steps}["points on objects"] == seen
    assert scene.wanted(None).all() and len(scene.wanted(None)) == len(scene.objects.points)
    monkeypatch.setattr(parallel, "available_cores", lambda: 1)
    alone, _ = prepare(points)
    np.testing.assert_array_equal(alone.objects.points, scene.objects.points)
    np.testing.assert_array_equal(alone.objects.normals, scene.objects.normals)


def test_flying_pixels_are_dropped_and_counted() -> None:
    points = shapes.single_view(shapes.box(0.06, 0.1, 0.12))
    flying = np.array([[0.2, 0.2, 0.95], [-0.2, 0.1, 1.0], [0.1, -0.2, 0.9]])
    scene, recorder = prepare(np.concatenate([points, flying]))
    assert scene.objects.points[:, 2].max() < 0.89
    counts = {s.name: s for s in recorder.steps}
    assert counts["points on objects"].kept + counts["points on objects"].rejected == len(scene.points)


def test_the_workspace_crops_before_everything_else() -> None:
    points = shapes.single_view(shapes.box(0.06, 0.1, 0.12))
    scene, recorder = prepare(points, workspace=Box((-0.2, -0.2, 0.7), (0.2, 0.2, 1.0)))
    assert np.abs(scene.points[:, :2]).max() <= 0.2
    assert recorder.steps[1].rejected == int((np.abs(points[:, :2]) > 0.2).any(axis=1).sum())


def test_the_rows_of_the_users_array_are_kept() -> None:
    points = shapes.single_view(shapes.box(0.06, 0.1, 0.12))
    points[::7] = np.nan
    scene, _ = prepare(points)
    assert np.array_equal(points[scene.source], scene.points)
    rows = scene.objects.source[scene.objects.observed]
    assert np.abs(points[rows] - scene.objects.points[scene.objects.observed]).max() < 0.02
    assert (scene.objects.source[~scene.objects.observed] == -1).all()


def test_a_cloud_is_thinned_where_many_points_share_a_voxel_or_there_are_too_many() -> None:
    points = shapes.single_view(shapes.box(0.06, 0.1, 0.12)).astype(np.float32)
    single = points[voxel_downsample(points, 0.002)]
    few_more = np.concatenate([single, single[::50]])
    scene, recorder = prepare(few_more)
    assert (
        len(scene.points) == len(few_more)
        and {s.name: s.rejected for s in recorder.steps}["points after thinning"] == 0
    )
    np.testing.assert_array_equal(scene.source, np.arange(len(few_more)))
    np.testing.assert_array_equal(few_more[scene.source], scene.points)
    for crowded in (np.concatenate([single, single[::8]]), np.concatenate([single, single, single])):
        scene, recorder = prepare(crowded)
        np.testing.assert_array_equal(scene.points, single)
        assert {s.name: s.rejected for s in recorder.steps}["points after thinning"] == len(crowded) - len(single)
    scene, _ = prepare(few_more, max_points=len(few_more) - 1)
    np.testing.assert_array_equal(scene.points, single)
    scene, _ = prepare(few_more, max_points=len(single) // 2)
    assert len(single) // 4 < len(scene.points) <= len(single) // 2


def test_a_wall_beside_a_large_floor_is_structure() -> None:
    rng = np.random.default_rng(0)
    axis = np.arange(0.0, 12.0, 0.0227)
    floor = np.stack(np.meshgrid(axis, axis, [0.0]), axis=-1).reshape(-1, 3)
    stray = np.column_stack([18.0 + rng.random(400), 6.0 + rng.random(400), np.zeros(400)])
    wall = np.column_stack([np.full(4000, 14.0), 5.0 + 2.0 * rng.random(4000), 0.4 * rng.random(4000)])
    box = np.concatenate([0.1 * rng.random((2000, 2)) + 6.0, np.full((2000, 1), 0.08)], axis=1)
    scene, _ = prepare(np.concatenate([floor, stray, wall, box]).astype(np.float32))
    assert len(scene.structure) > 3000
    assert scene.seen[:, 0].max() < 6.2 and len(scene.seen) > 500


def test_points_far_below_others_are_no_columns() -> None:
    rng = np.random.default_rng(0)
    above = np.concatenate([rng.random((3600, 2)) * 30.0, 5.0 + 45.0 * rng.random((3600, 1))], axis=1)
    below = np.concatenate([rng.random((25, 2)) * 0.01, np.zeros((25, 1))], axis=1)
    scene, _ = prepare(np.concatenate([above, below]))
    assert np.isfinite(scene.obstacles).all()
    tower = np.concatenate([rng.random((500, 2)) * 0.02, np.repeat([[0.0], [60.0]], 250, axis=0)], axis=1)
    scene, _ = prepare(tower)
    assert np.isfinite(scene.obstacles).all()


def test_a_scene_cannot_change_the_users_array() -> None:
    points = shapes.single_view(shapes.box(0.06, 0.1, 0.12)).astype(np.float32)
    thin = points[voxel_downsample(points, 0.002)]
    for given in (points, thin):
        scene, _ = prepare(given)
        assert not scene.points.flags.writeable and given.flags.writeable


def test_the_shadow_of_a_box_is_unseen_ground() -> None:
    scene, _ = prepare(shapes.single_view(shapes.box(0.06, 0.10, 0.12)))
    assert scene.ground is not None
    # The camera is at x = 0.8, 0.95 m above the table: the box's shadow reaches to about x = -0.15.
    assert scene.ground.at(np.array([[-0.08, 0.0], [-0.10, 0.02]])).all()
    assert not scene.ground.at(np.array([[0.1, 0.0], [0.0, 0.12], [-0.25, 0.0]])).any()
    assert scene.ground.at(np.array([[5.0, 5.0]])).all()


def test_maps_without_points_or_of_endless_size_are_refused() -> None:
    assert unseen_ground(np.zeros((0, 3)), np.zeros((0, 3))) is None
    assert unseen_ground(np.array([[0.0, 0, 0], [900.0, 900, 0]]), np.zeros((0, 3))) is None
