"""Point clouds: validation, sampling, normals and planes with known answers."""

import numpy as np
import pytest
import shapes

from regnet_core import Box, CloudError
from regnet_core.geometry import pose_matrix, transform_points
from regnet_core.ops.buckets import CornerBuckets
from regnet_core.ops.rows import spread_rows
from regnet_core.pointcloud import (
    colors_as_floats,
    crop,
    estimate_normals,
    neighbourhood_radius,
    orient_normals,
    place_points,
    random_sample,
    validate_colors,
    validate_points,
    voxel_downsample,
)
from regnet_core.support_plane import fit_support_plane


def test_invalid_points_are_dropped_and_the_rest_keeps_its_rows() -> None:
    points = np.array([[0, 0, 1], [np.nan, 0, 0], [0, np.inf, 0], [1, 2, 3], [0, 0, 1e30]])
    valid, index = validate_points(points)
    assert index.tolist() == [0, 3]
    assert np.array_equal(valid, points[[0, 3]])


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((4, 2)), r"shape \(N, 3\).*got \(4, 2\)"),
        (np.zeros(3), r"shape \(N, 3\)"),
        (np.zeros((4, 5, 3)), r"reshape\(-1, 3\)"),
        (np.array([["a", "b", "c"]]), "real numbers"),
        (np.zeros((2, 3), complex), "complex"),
        ([[0.0, 1.0], [1.0]], "array"),
    ],
)
def test_malformed_arrays_are_refused_with_what_would_be_right(points: object, message: str) -> None:
    with pytest.raises(CloudError, match=message):
        validate_points(points)


def test_colours_are_scaled_and_checked() -> None:
    assert colors_as_floats(np.array([[0, 255, 51]], np.uint8))[0].tolist() == [0.0, 1.0, 0.2]
    assert colors_as_floats(np.array([[0.0, 1.0, 0.2]]))[0].tolist() == [0.0, 1.0, 0.2]
    bytes_given = np.array([[0, 255, 51]], np.uint8)
    assert validate_colors(bytes_given, 1) is bytes_given and validate_colors(None, 1) is None
    with pytest.raises(CloudError, match=r"\(2, 3\)"):
        validate_colors(np.zeros((3, 3)), 2)
    for wrong in (np.array([[0, 256, 0]]), np.array([[0.0, 1.5, 0.0]]), np.array([[0.0, -0.1, 0.0]])):
        with pytest.raises(CloudError, match="got values from"):
            validate_colors(wrong, 1)


def test_crop_includes_the_faces_of_the_box() -> None:
    points = np.array([[0, 0, 0], [1, 1, 1], [1.001, 1, 1], [0.5, -0.001, 0.5]])
    assert crop(points, Box((0, 0, 0), (1, 1, 1))).tolist() == [0, 1]


def test_one_point_is_left_in_each_voxel() -> None:
    axis = np.arange(10) * 0.001 + 0.0005
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    kept = voxel_downsample(points, 0.005)
    cells = np.floor(points[kept] / 0.005).astype(int)
    assert len(kept) == 8
    assert len(np.unique(cells, axis=0)) == 8
    assert np.array_equal(voxel_downsample(points, 1e-9), np.arange(len(points)))
    with pytest.raises(CloudError, match="voxel size"):
        voxel_downsample(points, 0.0)


def test_random_sample_is_without_repetition_and_reproducible() -> None:
    a, b = (random_sample(1000, 100, np.random.default_rng(4)) for _ in range(2))
    assert np.array_equal(a, b)
    assert len(np.unique(a)) == 100
    for size in (0, 240, 251, 600, 999):  # few, and many
        rows = random_sample(1000, size, np.random.default_rng(1))
        assert len(rows) == size and (np.diff(rows) > 0).all() and (size == 0 or 0 <= rows[0] <= rows[-1] < 1000)
    for size in (5, 15):
        rng, counts = np.random.default_rng(2), np.zeros(40)
        for _ in range(4000):
            counts[random_sample(40, size, rng)] += 1
        share = size / 40
        assert np.abs(counts - 4000 * share).max() < 4.5 * np.sqrt(4000 * share * (1 - share))
    many = np.concatenate([random_sample(100_000, 500, rng) for _ in range(40)])  # in blocks
    assert np.abs(np.histogram(many, 10, (0, 100_000))[0] - 2000).max() < 4.5 * np.sqrt(20_000 * 0.1 * 0.9)
    assert random_sample(5, 10, np.random.default_rng(0)).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("most", [1, 30, 399, 400, 799, 800, 5000])
def test_points_are_drawn_evenly_from_all_that_are_usable(most: int) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (2400, 3))
    points[::3] = np.nan
    box = Box((-5.0, -5.0, -5.0), (0.0, 5.0, 5.0))
    whole = place_points(points, np.eye(4), box)
    draws = [place_points(points, np.eye(4), box, most, seed) for seed in range(300)]
    size = min(most, whole.inside)
    times, inside = np.zeros(len(points)), np.searchsorted(whole.rows, draws[0].rows)
    for draw in draws:
        assert draw.inside == whole.inside and len(draw.rows) == size and (np.diff(draw.rows) > 0).all()
        np.testing.assert_array_equal(draw.points, points[draw.rows])
        times[draw.rows] += 1
    assert (times[np.setdiff1d(np.arange(len(points)), whole.rows)] == 0).all()
    share = size / whole.inside
    assert np.abs(times[whole.rows] - 300 * share).max() <= 6 * np.sqrt(300 * share * (1 - share)) + 1e-9
    # One from about as many as each stands for.
    if size > 1:
        assert np.diff(inside).max() <= 2 / share + 2


@pytest.mark.parametrize(("count", "size"), [(0, 0), (7, 7), (10, 3), (100_000, 6000), (13, 0)])
def test_rows_are_spread_evenly(count: int, size: int) -> None:
    rng = np.random.default_rng(0)
    draws = [spread_rows(count, size, rng) for _ in range(200)]
    for rows in draws:
        assert len(rows) == size and (np.diff(rows) > 0).all()
        runs = count * np.arange(size + 1) // max(size, 1)
        assert (rows >= runs[:-1]).all() and (rows < runs[1:]).all()
    if size == 3:
        assert np.bincount(np.concatenate(draws), minlength=10).min() > 200 * 0.3 / 2


def test_it_does_not_matter_how_points_lie_in_memory() -> None:
    numbers = np.random.default_rng(0).uniform(-1, 1, (3000, 8)).astype(np.float32)
    numbers[::7, 2] = np.nan
    packed = np.zeros(3000, np.dtype([("flag", np.uint8), ("xyz", np.float32, 3)]))  # at odd addresses
    packed["xyz"] = numbers[:, :3]
    layouts = [numbers[:, 1:4], numbers[::3, :3], numbers[::-1, 5:], numbers[:, 4::-2], numbers.astype(float)[:, 2:5]]
    for points in (*layouts, np.asfortranarray(numbers[:, :3]), packed["xyz"], numbers[:1, :3], numbers[:0, :3]):
        for box, most in ((None, None), (Box((-0.5, -1.0, -1.0), (0.7, 1.0, 0.5)), 200)):
            expected = place_points(points.copy(order="C"), np.eye(4), box, most)
            found = place_points(points, np.eye(4), box, most)
            np.testing.assert_array_equal(found.points, expected.points)
            np.testing.assert_array_equal(found.rows, expected.rows)
            assert found[2:] == expected[2:]


def test_normals_of_a_sphere_are_radial() -> None:
    ball = shapes.sphere(0.05)
    local = estimate_normals(CornerBuckets.of(ball.points), 0.012)
    normals = orient_normals(local.normal, ball.points - [0, 0, shapes.TABLE + 0.05])
    assert np.sum(normals * ball.normals, axis=1).min() > 0.99


def test_neighbourhood_radius_holds_the_wanted_number() -> None:
    points = np.random.default_rng(0).uniform(0, 0.2, (8000, 3)) * [1, 1, 0]
    radius = neighbourhood_radius(CornerBuckets.of(points), neighbours=25, low=0.0, high=1.0)
    assert radius == pytest.approx(np.sqrt(25 / (np.pi * 8000 / 0.04)), rel=0.1)


def test_support_plane_of_a_table_under_a_box() -> None:
    plane = fit_support_plane(shapes.single_view(shapes.box(0.06, 0.1, 0.12)), np.random.default_rng(0))
    assert plane is not None
    assert plane.offset == pytest.approx(0.75, abs=5e-4)
    assert plane.normal == pytest.approx((0, 0, 1), abs=2e-3)


def test_support_plane_that_is_not_quite_level() -> None:
    points = shapes.single_view(shapes.box(0.06, 0.1, 0.12))
    tilt = np.radians(6)
    turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    plane = fit_support_plane(points @ turn.T, np.random.default_rng(0))
    assert plane is not None
    assert plane.normal == pytest.approx((np.sin(tilt), 0, np.cos(tilt)), abs=2e-3)


def test_a_wall_or_a_ball_is_no_support_plane() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.zeros(3000), rng.uniform(-1, 1, (3000, 2))])
    assert fit_support_plane(wall, rng) is None
    assert fit_support_plane(rng.normal(size=(3000, 3)), rng) is None
    assert fit_support_plane(wall[:20], rng) is None


def test_the_table_is_preferred_to_a_larger_floor_and_the_floor_to_a_box() -> None:
    rng = np.random.default_rng(0)
    scene = shapes.single_view(shapes.box(0.2, 0.2, 0.15), side=0.7)
    floor = np.column_stack([rng.uniform(-1.2, 1.2, (60000, 2)), np.zeros(60000)])
    floor = floor[(np.abs(floor[:, :2]) > 0.5).any(axis=1)] + rng.normal(0, 0.001, (1, 3))
    plane = fit_support_plane(np.concatenate([scene, floor]), rng)
    assert plane is not None
    assert plane.offset == pytest.approx(0.75, abs=1e-3)
    on_floor = np.concatenate([scene[scene[:, 2] > 0.76] - [0, 0, 0.75], floor])
    plane = fit_support_plane(on_floor, rng)
    assert plane is not None
    assert plane.offset == pytest.approx(0.0, abs=2e-3)


def test_a_small_table_alone_is_found() -> None:
    points = shapes.single_view(shapes.box(0.05, 0.05, 0.05), side=0.25)
    plane = fit_support_plane(points, np.random.default_rng(0))
    assert plane is not None
    assert plane.offset == pytest.approx(0.75, abs=1e-3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64])
def test_placing_is_validating_moving_and_cropping(dtype: type) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-2.5, 2.5, (500, 3)).astype(dtype)
    if dtype != np.int64:
        points[3, 1], points[7, 2], points[11, 0] = np.nan, np.inf, 1500.0
    transform, box = pose_matrix([0.1, -0.2, 0.3], [0.4, 0.5, -2.0]), Box((-1.0, -1.5, -0.5), (2.0, 1.0, 1.5))
    valid, rows = validate_points(points)
    moved = transform_points(transform, valid)
    inside = crop(moved, box)
    placed = place_points(points, transform, box)
    assert 0 < len(inside) < placed.valid == len(valid)
    assert placed.rows.tolist() == rows[inside].tolist()
    np.testing.assert_allclose(placed.points, moved[inside], atol=1e-12)
    assert place_points(points, transform).rows.tolist() == rows.tolist()
