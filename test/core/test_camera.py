"""Cameras, rendering and noise against geometry that is known in closed form."""

import numpy as np
import pytest

from regnet_core.data.cameras.camera import (
    KINECT_V2,
    PAPER_POSES,
    REALSENSE_D435,
    Camera,
    Intrinsics,
    from_euler,
    look_at,
    paper_cameras,
)
from regnet_core.data.cameras.colour_noise import ColourNoise
from regnet_core.data.cameras.dome import DomeConfig, dome_camera, dome_for
from regnet_core.data.cameras.noise import DepthNoise
from regnet_core.data.cameras.rendering import FIXTURE_ID, FLOOR_ID, NOTHING_ID, TABLE_ID, SceneRenderer
from regnet_core.data.cameras.sensors import SENSORS
from regnet_core.data.objects.models import ObjectModel, build_mesh
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box, transform_points

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


REGION = Box((-0.1, -0.15, 0.745), (0.2, 0.2, 1.0))
"""A part of the table and all of the block [m]."""


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


def test_a_seed_gives_the_same_image_and_another_seed_another(renderer: SceneRenderer) -> None:
    camera = paper_cameras(SMALL)[0]
    first, again, other = (renderer.render(camera, DepthNoise(), np.random.default_rng(s)) for s in (4, 4, 5))
    np.testing.assert_array_equal(first.depth, again.depth)
    assert np.nanmax(np.abs(first.depth - other.depth)) > 1e-3


def test_noise_needs_a_generator(renderer: SceneRenderer) -> None:
    with pytest.raises(ValueError, match="needs a numpy Generator"):
        renderer.render(_above(1.0), DepthNoise())


def test_fixtures_are_rendered_with_an_id_and_a_colour_of_their_own() -> None:
    scene = _block_scene()
    wall = Box((-0.2, -0.3, 0.75), (-0.19, 0.3, 0.85))
    view = SceneRenderer(Scene(scene.objects, scene.poses, scene.table, (wall,))).render(_above(1.0))
    seen = view.object_ids == FIXTURE_ID
    x, y, z = view.world_points()[seen].T
    assert np.all((x > -0.2001) & (x < -0.1899)) and np.all(np.abs(y) < 0.3001)
    assert z.max() == pytest.approx(0.85, abs=1e-5)
    assert not set(map(tuple, view.colours[seen])) & set(map(tuple, view.colours[view.object_ids == TABLE_ID]))


# A region of the image


@pytest.mark.parametrize("camera", [*paper_cameras(SMALL), _above(1.0), _above(0.02)])
def test_a_region_is_what_the_whole_image_shows_of_it(renderer: SceneRenderer, camera: Camera) -> None:
    whole, part = renderer.render(camera), renderer.render(camera, region=REGION)
    inside = REGION.contains(whole.world_points())
    np.testing.assert_array_equal(np.isfinite(part.depth), inside)
    for name in ("depth", "normals", "object_ids", "colours"):
        np.testing.assert_array_equal(getattr(part, name)[inside], getattr(whole, name)[inside])
    assert np.all(part.object_ids[~inside] == NOTHING_ID)
    assert not part.normals[~inside].any() and not part.colours[~inside].any()


def test_a_region_with_noise_holds_the_points_measured_inside(renderer: SceneRenderer) -> None:
    camera = paper_cameras(SMALL)[2]
    views = [renderer.render(camera, DepthNoise(), np.random.default_rng(3), region=REGION) for _ in range(2)]
    np.testing.assert_array_equal(views[0].depth, views[1].depth)
    points, index = views[0].cloud()
    assert len(points) > 300 and REGION.contains(points).all()
    np.testing.assert_allclose(points, views[0].world_points().reshape(-1, 3)[index], atol=1e-12)
    np.testing.assert_array_equal(views[0].object_ids.ravel()[index] == NOTHING_ID, False)


def test_a_region_out_of_sight_is_empty(renderer: SceneRenderer) -> None:
    view = renderer.render(_above(1.0), region=Box((5.0, 5.0, 0.0), (6.0, 6.0, 0.1)))
    assert view.depth.shape == (120, 160) and np.isnan(view.depth).all() and len(view.cloud()[0]) == 0


def test_the_window_of_a_box() -> None:
    # At 1 m, 0.1 m are 12 pixels; the image's down is the world's -y.
    window = _above(1.0).window(Box((-0.1, 0.1, 0.74), (0.2, 0.15, 0.75)), margin=2)
    assert window == (79 - 12 - 2, 59 - 18 - 2, 36 + 2 + 4, 6 + 2 + 4)
    intrinsics = SMALL.cropped(window)
    assert (intrinsics.width, intrinsics.height) == (window.width, window.height)
    whole = SMALL.rays(SMALL.pixels())[window.slices]
    np.testing.assert_allclose(intrinsics.rays(intrinsics.pixels()), whole)
    assert _above(1.0).window(Box((-9.0, -9.0, 0.0), (9.0, 9.0, 2.0))) == (0, 0, 160, 120), "partly behind the camera"


# Colours


def test_colour_noise_has_the_stated_spread(renderer: SceneRenderer) -> None:
    camera, rng = _above(1.0), np.random.default_rng(0)
    plain = renderer.render(camera)
    speckled = renderer.render(camera, None, rng, colour_noise=ColourNoise(pixel=4.0))
    table = plain.object_ids == TABLE_ID
    difference = speckled.colours[table].astype(float) - plain.colours[table]
    assert np.std(difference) == pytest.approx(np.hypot(4.0, 1.0 / np.sqrt(12.0)), rel=0.05)
    gains = [
        renderer.render(camera, None, rng, colour_noise=ColourNoise(brightness=0.2)).colours[table].mean()
        / plain.colours[table].mean()
        for _ in range(30)
    ]
    assert 0.1 < np.std(np.log(gains)) < 0.3
    same = renderer.render(camera, None, rng, colour_noise=ColourNoise())
    np.testing.assert_array_equal(same.colours, plain.colours)
    with pytest.raises(ValueError, match="needs a numpy Generator"):
        renderer.render(camera, colour_noise=ColourNoise(pixel=1.0))


# Cameras on a dome


def test_dome_cameras_have_the_middle_of_the_table_in_the_middle_of_the_image() -> None:
    rng, table = np.random.default_rng(0), default_table()
    for sensor in SENSORS.values():
        intrinsics = sensor.intrinsics
        for _ in range(200):
            camera = dome_camera(rng, intrinsics, table, dome_for(sensor))
            middle = camera.T_world_camera[:3, :3].T @ ([0.0, 0.0, 0.75] - camera.position)
            pixel = intrinsics.matrix @ middle / middle[2]
            assert abs(pixel[0] - intrinsics.cx) < 0.2 * intrinsics.width
            assert abs(pixel[1] - intrinsics.cy) < 0.2 * intrinsics.height
            assert np.linalg.det(camera.T_world_camera[:3, :3]) == pytest.approx(1.0)
            assert middle[2] - 0.25 > sensor.noise.near - 0.06, "the tops of objects are in range"


def test_dome_cameras_cover_the_ranges() -> None:
    rng, config = np.random.default_rng(1), DomeConfig(aim=0.0)
    cameras = [dome_camera(rng, SMALL, default_table(), config) for _ in range(500)]
    away = np.array([camera.position - [0.0, 0.0, 0.75] for camera in cameras])
    distance = np.linalg.norm(away, axis=1)
    elevation = np.degrees(np.arcsin(away[:, 2] / distance))
    assert 0.5 <= distance.min() < 0.55 and 1.25 < distance.max() <= 1.3
    assert 25.0 <= elevation.min() < 27.0 and 80.0 < elevation.max() <= 85.0
    assert np.all(np.histogram(np.arctan2(away[:, 1], away[:, 0]), bins=8)[0] > 30), "every azimuth"
    # The right of a level camera is horizontal: what is left is the roll, less where the camera looks down steeply.
    roll = np.degrees(np.arcsin([camera.T_world_camera[2, 0] for camera in cameras]) / np.cos(np.radians(elevation)))
    assert 5.0 < np.abs(roll).max() < 10.5


def test_a_dome_camera_may_be_straight_above() -> None:
    config = DomeConfig(elevation=(0.5 * np.pi, 0.5 * np.pi), distance=(0.8, 0.8), roll=0.0, aim=0.0)
    camera = dome_camera(np.random.default_rng(0), SMALL, default_table(), config)
    np.testing.assert_allclose(camera.forward, [0.0, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(camera.position, [0.0, 0.0, 1.55], atol=1e-12)


def test_a_dome_within_the_near_range_is_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"DomeConfig.distance is \(least, largest\)"):
        dome_for(SENSORS["kinect_v2"], DomeConfig(distance=(0.3, 0.6)))
