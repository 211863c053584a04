"""The cloud that all methods get: cropped to the objects, thinned, and the same at each call."""

import numpy as np
import pytest

from regnet_core.data.cameras.dome import DomeConfig
from regnet_core.data.storage.archive import SceneArchive, view_points
from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.observed import AROUND, RecordedViews, cropped_and_drawn
from regnet_core.evaluation.unseen_camera import PLACES, UNSEEN, UnseenViews, beyond_training


def _table_with_a_post() -> tuple[np.ndarray, np.ndarray]:
    """A table of 1 m, a point each centimetre, with a post of 0.3 m in the middle; and which points are the post."""
    x, y = np.meshgrid(np.arange(-50, 51) / 100.0, np.arange(-50, 51) / 100.0)
    table = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    post = np.stack([np.zeros(31), np.zeros(31), np.arange(31) / 100.0], axis=1)
    points = np.concatenate([table, post, [[0.05, 0.0, 2.0]]])
    return points, np.arange(len(points)) // len(table) * (np.arange(len(points)) < len(points) - 1) > 0


def test_the_crop_is_the_box_around_the_objects_and_a_margin_at_all_heights() -> None:
    points, foreground = _table_with_a_post()
    rows = cropped_and_drawn(points, foreground, 10**6, np.random.default_rng(0))
    kept = points[rows]
    assert np.abs(kept[:, :2]).max() == pytest.approx(AROUND)
    assert (rows == np.sort(rows)).all()
    on_the_table = kept[kept[:, 2] == 0.0]
    assert len(on_the_table) == 21 * 21 + 1  # every point within 10 cm, and the foot of the post
    assert kept[:, 2].max() == 2.0  # far above, and not of the post


def test_no_point_is_drawn_twice_and_few_points_stay_as_they_are() -> None:
    points, foreground = _table_with_a_post()
    every = cropped_and_drawn(points, foreground, 10**6, np.random.default_rng(0))
    some = cropped_and_drawn(points, foreground, 100, np.random.default_rng(0))
    other = cropped_and_drawn(points, foreground, 100, np.random.default_rng(1))
    assert len(some) == len(set(some)) == 100 and set(some) < set(every)
    assert set(some) != set(other)
    assert cropped_and_drawn(points, foreground, len(every), np.random.default_rng(2)).tolist() == every.tolist()
    assert len(cropped_and_drawn(points, np.zeros(len(points), bool), 10**6, np.random.default_rng(0))) == len(points)


def test_a_recorded_cloud_is_part_of_its_view(tiny: SceneArchive) -> None:
    cloud = RecordedViews(4000)(tiny, 1, 1)
    info, data = tiny.info(1), tiny.view(1, 1)
    rows, columns = np.nonzero(np.isfinite(data.depth))
    seen = view_points(info.views[1], data, rows, columns).astype(np.float64)
    assert cloud.points.shape == (4000, 3) and len(np.unique(cloud.points, axis=0)) == 4000
    assert {tuple(point) for point in cloud.points} <= {tuple(point) for point in seen}
    objects = seen[data.object_index[rows, columns] != -1]
    assert (cloud.points[:, :2] >= objects[:, :2].min(axis=0) - AROUND).all()
    assert (cloud.points[:, :2] <= objects[:, :2].max(axis=0) + AROUND).all()
    np.testing.assert_array_equal(cloud.viewpoint, info.views[1].camera.position)
    assert cloud.plane.height(np.array([0.3, 0.1, info.table.upper[2]])) == 0.0


def test_scene_view_and_seed_decide_which_points(tiny: SceneArchive) -> None:
    source = RecordedViews(1000, seed=3)
    np.testing.assert_array_equal(source(tiny, 0, 1).points, RecordedViews(1000, seed=3)(tiny, 0, 1).points)
    assert not np.array_equal(source(tiny, 0, 1).points, RecordedViews(1000, seed=4)(tiny, 0, 1).points)
    whole = RecordedViews(10**6)(tiny, 0, 1).points
    np.testing.assert_array_equal(whole, RecordedViews(10**6, seed=4)(tiny, 0, 1).points)


@pytest.mark.parametrize("wrong", [{"points": 0}, {"seed": -1}])
def test_impossible_clouds_are_refused(wrong: dict) -> None:
    with pytest.raises(InvalidInputError):
        RecordedViews(**wrong)
    with pytest.raises(InvalidInputError):
        UnseenViews(**wrong)


def test_the_unseen_camera_is_outside_of_what_data_sets_have(tiny: SceneArchive) -> None:
    assert PLACES.distance[0] > 1.25 * DomeConfig().distance[1]
    for scene in tiny:
        cloud = UnseenViews()(tiny, scene, 0)
        height = cloud.viewpoint[2] - tiny.scene(scene).table_height
        assert 1.5 < height < 1.73
        for view in tiny.info(scene).views:
            intrinsics = view.camera.intrinsics
            assert (intrinsics.width, intrinsics.height) != (UNSEEN.intrinsics.width, UNSEEN.intrinsics.height)
    rows = {row.what: row for row in beyond_training(1.5)}
    assert rows["height above the table [m]"].training == "0.21 to 1.30"
    assert rows["height above the table [m]"].unseen == "1.50 to 1.72"
    noise = rows["depth noise, frontal, farthest [mm]"]
    assert float(noise.unseen.split()[0]) > float(noise.training.split()[-1])


def test_the_unseen_camera_sees_the_true_scene_with_noise(tiny: SceneArchive) -> None:
    exact, noisy = UnseenViews(noise=0.0)(tiny, 0, 0), UnseenViews()(tiny, 0, 0)
    np.testing.assert_array_equal(exact.viewpoint, noisy.viewpoint)
    table = exact.points[np.abs(exact.plane.height(exact.points)) < 1e-5]
    assert len(table) > 1000  # rays that meet the table end on it exactly
    assert exact.plane.height(exact.points).min() > -1e-5
    below = noisy.plane.height(noisy.points)
    assert below.min() < -0.008
    np.testing.assert_array_equal(noisy.points, UnseenViews()(tiny, 0, 0).points)
    assert not np.array_equal(noisy.viewpoint, UnseenViews()(tiny, 0, 1).viewpoint)
