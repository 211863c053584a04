"""The depth cameras' noise against its formulas."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from regnet_core.data.cameras.camera import Camera, look_at
from regnet_core.data.cameras.noise import DepthNoise, add_depth_noise, axial_sigma, depth_edges, quantised, shadows
from regnet_core.data.cameras.rendering import SceneRenderer
from regnet_core.data.cameras.sensors import SENSORS
from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.errors import InvalidInputError

SPREAD = {
    # Standard deviation on a wall at 1 m and 2 m [m], worked out by hand from the published formulas.
    "kinect_v2": (1.5e-3 - 0.5e-3 + 0.3e-3, 1.5e-3 - 1.0e-3 + 1.2e-3),
    "kinect_v1": (1.2e-3 + 1.9e-3 * 0.6**2, 1.2e-3 + 1.9e-3 * 1.6**2),
    "realsense_d435": (0.08 / (385.0 * 0.05), 4.0 * 0.08 / (385.0 * 0.05)),
}


def _noisy_wall(sensor: str, depth: float, **changes: float) -> np.ndarray:
    """A wall that fills the image, as the sensor sees it, straight ahead."""
    wall = np.full((300, 300), depth)
    noise = SENSORS[sensor].noise
    for name, value in changes.items():
        noise = DepthNoise(**{**vars(noise), name: value})
    return add_depth_noise(wall, np.zeros_like(wall), noise, np.random.default_rng(0))


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("z", [1.0, 2.0])
def test_a_wall_has_the_published_spread(sensor: str, z: float) -> None:
    noise = SENSORS[sensor].noise
    seen = _noisy_wall(sensor, z)
    seen = seen[np.isfinite(seen)]
    steps = [noise.quantum, z * z * noise.disparity_step / noise.disparity if noise.disparity else 0.0]
    expected = np.hypot(SPREAD[sensor][round(z) - 1], np.linalg.norm(steps) / np.sqrt(12.0))
    assert np.std(seen) == pytest.approx(expected, rel=0.06)
    assert np.mean(seen) == pytest.approx(z, abs=0.15 * expected)


def test_stereo_noise_is_alike_over_a_few_pixels_and_time_of_flight_noise_is_not() -> None:
    def alike(sensor: str, apart: int) -> float:
        error = _noisy_wall(sensor, 1.0, dropout=0.0) - 1.0
        return float(np.corrcoef(error[:, apart:].ravel(), error[:, :-apart].ravel())[0, 1])

    assert abs(alike("kinect_v2", 1)) < 0.02
    # White noise smoothed by a Gaussian of s pixels: exp(-d^2 / (4 s^2)).
    assert alike("realsense_d435", 1) == pytest.approx(np.exp(-1.0 / 9.0), abs=0.05)
    assert alike("realsense_d435", 3) == pytest.approx(np.exp(-1.0), abs=0.05)
    assert abs(alike("realsense_d435", 12)) < 0.05


@pytest.mark.parametrize(
    ("sensor", "step", "focal_baseline"), [("kinect_v1", 0.125, 43.5), ("realsense_d435", 1.0 / 32.0, 19.25)]
)
def test_depth_comes_in_steps_of_the_disparity(sensor: str, step: float, focal_baseline: float) -> None:
    noise = DepthNoise(**{**vars(SENSORS[sensor].noise), "quantum": 0.0})
    for z in (0.7, 1.0, 2.0):
        values = np.unique(quantised(np.linspace(z - 0.05, z + 0.05, 5001), noise))
        np.testing.assert_allclose(focal_baseline / values / step, np.round(focal_baseline / values / step), atol=1e-6)
        assert np.median(np.diff(values)) == pytest.approx(z * z * step / focal_baseline, rel=0.05)
    millimetres = 1000.0 * quantised(np.linspace(0.9, 1.1, 777), SENSORS[sensor].noise)
    np.testing.assert_allclose(millimetres, np.round(millimetres), atol=1e-9)


@pytest.mark.parametrize("sensor", SENSORS)
def test_nothing_returns_beyond_the_grazing_angle_or_the_range(sensor: str) -> None:
    noise = SENSORS[sensor].noise
    depth, angle = np.full((40, 40), 1.0), np.full((40, 40), noise.grazing - 0.01)
    angle[:, :20] = noise.grazing + 0.01
    noisy = add_depth_noise(depth, angle, noise, np.random.default_rng(0))
    assert np.isnan(noisy[:, :20]).all() and np.isfinite(noisy[:, 20:]).mean() > 0.97
    for z in (noise.near - 0.05, noise.far + 0.6):
        assert np.isnan(_noisy_wall(sensor, z)).all()


@pytest.mark.parametrize("sensor", SENSORS)
def test_without_strength_there_is_no_effect(sensor: str) -> None:
    depth = np.full((60, 60), 1.0)
    depth[:, 30:] = 1.5  # its shadow, if any, stays: it is on the left of near things, so this one has none
    noisy = add_depth_noise(depth, np.zeros_like(depth), SENSORS[sensor].noise.scaled(0.0), np.random.default_rng(0))
    np.testing.assert_array_equal(noisy, depth)


def test_scaling_scales_the_spread_and_keeps_shares_shares() -> None:
    noise = SENSORS["realsense_d435"].noise
    wall = np.full((300, 300), 1.0)
    once, thrice = (
        np.nanstd(add_depth_noise(wall, np.zeros_like(wall), noise.scaled(k), np.random.default_rng(1))) for k in (1, 3)
    )
    assert thrice == pytest.approx(3.0 * once, rel=0.03)
    assert noise.scaled(1.0) == noise
    wild = noise.scaled(5.0)
    assert wild.edge_loss + wild.edge_flying + wild.edge_bleeding == pytest.approx(1.0)
    assert wild.dropout == pytest.approx(5.0 * noise.dropout) and wild.near == noise.near
    with pytest.raises(InvalidInputError, match="factor of the noise"):
        noise.scaled(-1.0)


def test_the_shadow_of_a_near_thing_is_as_wide_as_the_difference_of_the_disparities() -> None:
    depth = np.full((5, 200), 1.0)
    depth[:, 100:150] = 0.8
    hidden = shadows(depth, disparity=43.5)
    # Disparities 43.5 and 54.4 pixels: the 10 pixels to the left of the near thing are hidden from the right eye.
    np.testing.assert_array_equal(np.flatnonzero(hidden[2]), np.arange(90, 100))
    depth[:] = np.nan
    assert not shadows(depth, 43.5).any()


def test_stereo_fattens_near_things() -> None:
    depth = np.full((400, 60), 1.0)
    depth[:, 30:] = 1.5  # to the right of the near thing, where it casts no shadow
    bled = {}
    for name, sensor in SENSORS.items():
        noisy = add_depth_noise(depth, np.zeros_like(depth), sensor.noise, np.random.default_rng(1))
        bled[name] = np.mean(np.abs(noisy[:, 30:33] - 1.0) < 0.02)
        assert np.nanmedian(noisy[:, 36]) == pytest.approx(1.5, abs=0.01), "the edge is narrow"
    assert bled["kinect_v2"] < 0.02
    assert bled["realsense_d435"] == pytest.approx(0.35, abs=0.06)


def test_numbers_that_make_no_sense_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"DepthNoise.edge_loss must be in \[0, 1\], got 1.2"):
        DepthNoise(edge_loss=1.2)
    with pytest.raises(InvalidInputError, match=r"at most 1 together, got 1\.2"):
        DepthNoise(edge_loss=0.6, edge_flying=0.6)
    with pytest.raises(InvalidInputError, match="near must be less than far"):
        DepthNoise(near=2.0, far=1.0)
    with pytest.raises(InvalidInputError, match="needs disparity"):
        DepthNoise(disparity_step=0.125)


@pytest.mark.parametrize("sensor", SENSORS)
def test_every_sensor_renders_a_table(sensor: str) -> None:
    scene = Scene((), np.zeros((0, 4, 4)), default_table())
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 1.75)
    view = SceneRenderer(scene).render(
        Camera(SENSORS[sensor].intrinsics, T), SENSORS[sensor].noise, np.random.default_rng(0)
    )
    middle = view.depth[180:240, 220:290]
    assert np.isfinite(middle).mean() > 0.98
    assert np.nanmean(middle) == pytest.approx(1.0, abs=0.002)


# A Kinect v2, the default


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


def test_pixels_that_show_a_nearer_depth_show_that_surface() -> None:
    rng = np.random.default_rng(0)
    box = ObjectModel("box", "box", {}, trimesh.creation.box((0.1, 0.1, 0.15)), (250, 0, 0), 500.0, 0.5)
    pose = np.eye(4)
    pose[2, 3] = 0.75 + 0.075
    renderer = SceneRenderer(Scene((box,), pose[None], default_table()))
    sensor = SENSORS["realsense_d435"]
    camera = Camera(sensor.intrinsics, look_at((0.5, 0.2, 1.3), (0.0, 0.0, 0.8)))
    noise = replace(sensor.noise, edge_flying=0.0, axial=0.0, lateral=0.0)
    view = renderer.render(camera, noise, rng)
    exact = renderer.render(camera)
    points, pixels = view.cloud()
    # Far above the table there is nothing but the box.
    high = points[:, 2] > 0.79
    assert np.all(view.object_ids.ravel()[pixels[high]] == 0)
    assert (view.object_ids != exact.object_ids).sum() > 20
