"""Cameras, rendering and noise against geometry that is known in closed form."""

import numpy as np
import pytest

from regnet_core.data.camera import (
    KINECT_V2,
    PAPER_POSES,
    REALSENSE_D435,
    Camera,
    Intrinsics,
    from_euler,
    look_at,
    paper_cameras,
)
from regnet_core.data.noise import DepthNoise, add_depth_noise, axial_sigma, depth_edges
from regnet_core.data.objects import ObjectModel, build_mesh
from regnet_core.data.rendering import FLOOR_ID, NOTHING_ID, TABLE_ID, SceneRenderer
from regnet_core.data.scenes import Scene, default_table
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import transform_points

SMALL = Intrinsics(160, 120, 120.0, 120.0, 79.5, 59.5)


def _block_scene() -> Scene:
    """A block of 0.06 x 0.04 x 0.1 m that stands at (0.1, 0.05) on the table."""
    params = {"x": 0.06, "y": 0.04, "z": 0.1}
    block = ObjectModel("block", "box", params, build_mesh("box", params), (200, 30, 30), 500.0, 0.5)
    pose = np.eye(4)
    pose[:3, 3] = 0.1, 0.05, 0.8
    return Scene((block,), pose[None], default_table())


@pytest.fixture(scope="module")
def renderer() -> SceneRenderer:
    return SceneRenderer(_block_scene())


def _above(height: float, intrinsics: Intrinsics = SMALL) -> Camera:
    """Looks straight down at the table's middle, the image's right along the world's x."""
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = 0.0, 0.0, 0.75 + height
    return Camera(intrinsics, T)


def _where_it_looks(camera: Camera) -> np.ndarray:
    """Where the viewing axis meets the table's plane, (2,) [m]."""
    t = (0.75 - camera.position[2]) / camera.forward[2]
    return (camera.position + t * camera.forward)[:2]


def test_the_papers_cameras_look_at_the_middle_of_the_table() -> None:
    for camera in paper_cameras():
        assert np.linalg.norm(_where_it_looks(camera)) < 0.1
        assert np.linalg.det(camera.T_world_camera[:3, :3]) == pytest.approx(1.0)


def test_the_second_camera_misses_the_middle_when_read_in_radians() -> None:
    as_printed = Camera(KINECT_V2, from_euler((0.0, -0.2221, 0.0), PAPER_POSES[1][1]))
    assert np.linalg.norm(_where_it_looks(as_printed)) > 0.5


def test_a_level_camera_has_x_right_y_down_z_forward() -> None:
    camera = Camera(SMALL, look_at((1.0, 0.0, 1.5), (0.0, 0.0, 0.75)))
    right, down, forward = camera.T_world_camera[:3, :3].T
    np.testing.assert_allclose(right, [0.0, 1.0, 0.0], atol=1e-12)  # seen from +x, +y is on the right
    assert down[2] < -0.5
    np.testing.assert_allclose(forward, np.array([-1.0, 0.0, -0.75]) / 1.25)
    np.testing.assert_allclose(np.cross(right, down), forward, atol=1e-12)


def test_a_level_camera_cannot_look_straight_down() -> None:
    with pytest.raises(InvalidInputError, match="cannot look straight up or down"):
        look_at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0))


def test_a_pose_that_is_not_rigid_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="rigid transform"):
        Camera(SMALL, 2.0 * np.eye(4))


def test_rays_pass_through_the_pixels_they_come_from() -> None:
    rays = REALSENSE_D435.rays(REALSENSE_D435.pixels())
    assert rays.shape == (480, 640, 3)
    projected = rays @ REALSENSE_D435.matrix.T
    np.testing.assert_allclose(projected[7, 11], [11.0, 7.0, 1.0])


def test_depth_is_exact_without_noise(renderer: SceneRenderer) -> None:
    view = renderer.render(_above(1.0))
    assert view.depth.shape == (120, 160)
    assert view.depth[60, 80] == pytest.approx(1.0, abs=1e-6)  # the table
    block = view.object_ids == 0
    top = block & (view.normals[..., 2] > 0.99)
    np.testing.assert_allclose(view.depth[top], 0.9, atol=1e-6)
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    x, y = (columns - 79.5) / 120.0 * 0.9, -(rows - 59.5) / 120.0 * 0.9
    inside = (np.abs(x - 0.1) < 0.029) & (np.abs(y - 0.05) < 0.019)
    assert np.all(top[inside]) and not np.any(top & ((np.abs(x - 0.1) > 0.031) | (np.abs(y - 0.05) > 0.021)))


def test_world_points_lie_on_the_surfaces_from_every_camera(renderer: SceneRenderer) -> None:
    for camera in paper_cameras(SMALL):
        view = renderer.render(camera)
        world = view.world_points()
        np.testing.assert_allclose(world[view.object_ids == FLOOR_ID][:, 2], 0.0, atol=1e-5)
        upper = (view.object_ids == TABLE_ID) & (view.normals[..., 2] > 0.5)
        np.testing.assert_allclose(world[upper][:, 2], 0.75, atol=1e-5)
        block = world[view.object_ids == 0] - [0.1, 0.05, 0.8]
        assert len(block) > 20
        np.testing.assert_allclose(np.max(np.abs(block) / [0.03, 0.02, 0.05], axis=1), 1.0, atol=1e-3)


def test_points_are_in_the_optical_frame(renderer: SceneRenderer) -> None:
    view = renderer.render(paper_cameras(SMALL)[0])
    points = view.points()
    np.testing.assert_array_equal(points[..., 2], view.depth)
    world = transform_points(view.camera.T_world_camera, points[60, 80][None])[0]
    np.testing.assert_allclose(world, view.world_points()[60, 80])
    assert points[60, 150, 0] > 0.0 > points[60, 10, 0]
    assert points[110, 80, 1] > 0.0 > points[10, 80, 1]


def test_normals_face_the_camera_and_nothing_is_nothing(renderer: SceneRenderer) -> None:
    view = renderer.render(Camera(SMALL, look_at((0.9, 0.3, 1.0), (0.0, 0.0, 0.9))))
    hit = view.object_ids != NOTHING_ID
    assert 0 < hit.sum() < hit.size
    np.testing.assert_allclose(np.linalg.norm(view.normals[hit], axis=1), 1.0, atol=1e-5)
    towards = view.camera.position - view.world_points()[hit]
    assert np.all(np.einsum("ni,ni->n", towards, view.normals[hit]) >= 0.0)
    assert np.all(np.isnan(view.depth[~hit])) and np.all(view.colours[~hit] == 0)


def test_colours_are_those_of_the_objects(renderer: SceneRenderer) -> None:
    view = renderer.render(_above(1.0))
    red, green, blue = view.colours[view.object_ids == 0].T.astype(int)
    assert np.all(red > 3 * green) and np.all(red > 3 * blue)


def test_axial_sigma_is_fankhausers_formula() -> None:
    depth, angle = np.array([1.0, 2.0, 1.0]), np.array([0.0, 0.0, np.pi / 4])
    np.testing.assert_allclose(axial_sigma(depth, angle), [1.3e-3, 1.7e-3, 1.4e-3])


def test_noise_on_a_flat_wall_has_the_stated_spread() -> None:
    depth = np.full((200, 200), 2.0)
    noisy = add_depth_noise(depth, np.zeros((200, 200)), DepthNoise(), np.random.default_rng(0))
    seen = np.isfinite(noisy)
    # 1.7 mm of axial noise and 1 mm / sqrt(12) of rounding
    assert np.std(noisy[seen]) == pytest.approx(np.hypot(1.7e-3, 1e-3 / np.sqrt(12.0)), rel=0.03)
    assert np.mean(noisy[seen]) == pytest.approx(2.0, abs=1e-4)
    np.testing.assert_allclose(noisy[seen] * 1000.0, np.round(noisy[seen] * 1000.0), atol=1e-9)
    assert np.mean(~seen) == pytest.approx(0.001, abs=0.001)


def test_grazing_and_distant_pixels_are_lost() -> None:
    depth = np.full((20, 20), 1.0)
    depth[:, 15:] = 6.0
    angle = np.zeros((20, 20))
    angle[:, :5] = np.radians(81.0)
    noisy = add_depth_noise(depth, angle, DepthNoise(edge_loss=0.0, dropout=0.0), np.random.default_rng(0))
    assert np.all(np.isnan(noisy[:, :5])) and np.all(np.isnan(noisy[:, 15:]))
    assert np.all(np.isfinite(noisy[:, 6:13]))


def test_a_slope_is_no_edge_but_a_step_is() -> None:
    slope = 1.0 / np.linspace(1.0, 0.4, 60)[None].repeat(40, axis=0)  # a plane seen at a grazing angle
    assert np.diff(slope, axis=1).max() > 0.05
    assert not depth_edges(slope, 0.015).any()
    step = np.full((40, 60), 1.0)
    step[:, 30:] = 1.05
    edges = depth_edges(step, 0.015)
    assert np.all(edges[:, 29:31]) and not edges[:, :29].any() and not edges[:, 31:].any()
    step[:, 30:] = np.nan
    assert np.all(depth_edges(step, 0.015)[:, 29])


def test_edges_lose_pixels_and_some_fly_behind() -> None:
    depth = np.full((400, 60), 1.0)
    depth[:, 30:] = 1.5
    noisy = add_depth_noise(depth, np.zeros_like(depth), DepthNoise(), np.random.default_rng(1))
    front = noisy[:, 29]
    assert np.mean(np.isnan(front)) == pytest.approx(0.35, abs=0.08)
    flying = (front > 1.02) & (front < 1.48)
    assert 0.02 < np.mean(flying) < 0.15
    assert not np.any((noisy[:, :28] > 1.02) & (noisy[:, :28] < 1.48))


def test_a_seed_gives_the_same_image_and_another_seed_another(renderer: SceneRenderer) -> None:
    camera = paper_cameras(SMALL)[0]
    first, again, other = (renderer.render(camera, DepthNoise(), np.random.default_rng(s)) for s in (4, 4, 5))
    np.testing.assert_array_equal(first.depth, again.depth)
    assert np.nanmax(np.abs(first.depth - other.depth)) > 1e-3


def test_noise_needs_a_generator(renderer: SceneRenderer) -> None:
    with pytest.raises(ValueError, match="needs a numpy Generator"):
        renderer.render(_above(1.0), DepthNoise())
