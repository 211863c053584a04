"""The candidates of GPD and PointNetGPD: local frames, where hands are placed, and what they promise."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shapes import TABLE, box, cylinder, single_view

from regnet_core.baselines.darboux import local_frames
from regnet_core.baselines.finger_placement import place_fingers
from regnet_core.baselines.gpg import Candidates, GpgConfig, GpgSampler, hand_frames
from regnet_core.collision import CollisionConfig
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Plane
from regnet_core.gripper import Gripper
from regnet_core.ops.voxel_grid import build_grid
from regnet_core.report import StepRecorder
from regnet_core.scene import Scene, SceneConfig, prepare_scene

GRIPPER = Gripper(width=0.07)
DOWN = Rotation.from_matrix([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]).as_matrix()
"""Approach -z, closing direction x, and their product -y."""


@pytest.fixture(scope="module")
def scene() -> Scene:
    cloud = single_view(box(0.05, 0.06, 0.10))
    return prepare_scene(cloud, None, SceneConfig(), np.random.default_rng(0), StepRecorder())


def sample(scene: Scene, seed: int = 0, config: GpgConfig | None = None, gripper: Gripper = GRIPPER) -> Candidates:
    everywhere = np.ones(len(scene.objects.points), bool)
    return GpgSampler(config).sample(scene, gripper, everywhere, np.random.default_rng(seed))


# Local frames


def test_the_frame_of_a_cylinder_has_its_axis() -> None:
    solid = cylinder(0.03, 0.20)
    wall = np.abs(solid.normals[:, 2]) < 0.5
    points, normals = solid.points[wall], solid.normals[wall]
    grid = build_grid(points, 0.01)
    inside = np.flatnonzero(np.abs(points[:, 2] - TABLE - 0.10) < 0.05)[::37]
    frames = local_frames(grid, normals[grid.order], points[inside], 0.01)
    assert len(inside) > 20 and frames.neighbours.min() >= 8
    assert np.abs(frames.axis[:, 2]).min() > 0.999
    np.testing.assert_allclose(frames.normal, normals[inside], atol=0.12)
    np.testing.assert_allclose(frames.binormal, np.cross(frames.axis, frames.normal), atol=1e-12)
    for vectors in frames[:3]:
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0)


def test_the_frame_is_that_of_the_neighbours_normals() -> None:
    """Two normals, (0, 0, 1) thrice and (0.6, 0, 0.8) once: by hand, M = [[.36, 0, .48], [0, 0, 0], [.48, 0, 3.64]]."""
    points = np.array([[0.0, 0, 0], [0.002, 0, 0], [0, 0.002, 0], [0.004, 0, 0], [0.5, 0, 0]])
    normals = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 1], [0.6, 0, 0.8], [1, 0, 0]])
    grid = build_grid(points, 0.01)
    frame = local_frames(grid, normals[grid.order], points[:1], 0.01)
    assert frame.neighbours[0] == 4
    np.testing.assert_allclose(np.abs(frame.axis[0]), [0, 1, 0], atol=1e-12)
    turn = 0.5 * np.arctan2(2 * 0.48, 3.64 - 0.36)  # of the largest eigenvector away from z
    np.testing.assert_allclose(frame.normal[0], [np.sin(turn), 0, np.cos(turn)], atol=1e-12)
    alone = local_frames(grid, normals[grid.order], np.array([[9.0, 9, 9]]), 0.01)
    assert alone.neighbours[0] == 0 and np.isfinite(alone.normal).all()


def test_hands_turn_about_the_axis_of_least_curvature() -> None:
    solid = cylinder(0.03, 0.20)
    grid = build_grid(solid.points, 0.01)
    frames = local_frames(grid, solid.normals[grid.order], solid.points[:5], 0.01)
    hands = hand_frames(frames, 4, np.arange(20)).reshape(5, 4, 3, 3)
    for point in range(5):
        np.testing.assert_allclose(np.abs(hands[point, :, :, 2] @ frames.axis[point]), 1.0)
        np.testing.assert_allclose(hands[point, 2, :, 0], -frames.normal[point], atol=1e-12)  # the angle 0
        np.testing.assert_allclose(hands[point, 2, :, 1], frames.binormal[point], atol=1e-12)
        steps = np.einsum("ai,ai->a", hands[point, :-1, :, 0], hands[point, 1:, :, 0])
        np.testing.assert_allclose(steps, np.cos(np.pi / 4), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(hands.reshape(-1, 3, 3)), 1.0)


# Placement


def place(points: list[list[float]], plane: Plane | None = None, **values: float):  # type: ignore[no-untyped-def]
    grid = build_grid(np.array(points, float), 0.012)
    return place_fingers(DOWN[None], np.zeros((1, 3)), Gripper(width=0.08), grid, plane, **values)


def test_a_hand_over_a_single_point_goes_down_to_the_palm() -> None:
    """Ten places, 8 mm apart, are all free; the lower one of the middle two is taken. The palm stops 2 mm above."""
    found = place([[0.0, 0.0, 0.0]])
    assert found.found[0]
    assert found.offset[0] == pytest.approx(-0.004)
    assert found.reach[0] == pytest.approx(0.06 - 0.002)


def test_a_point_in_a_fingers_way_stops_its_tip() -> None:
    """A point 2 cm below and 4 cm to the side: at offset +0.004 the finger there would cover y = 0.044 to 0.054."""
    at = [[0.0, 0.0, 0.0], [0.042, 0.0, -0.02]]
    found = place(at)
    places = ((np.arange(10) + 0.5) / 10 - 0.5) * 0.08
    beside = np.abs(0.042 - places)
    reach = np.where((beside >= 0.04) & (beside <= 0.052), 0.018, 0.058)
    reach = np.where(beside < 0.04, np.minimum(reach, 0.02 + 0.058), reach)
    fit = np.flatnonzero(reach >= 0.01)
    chosen = fit[(len(fit) + 1) // 2 - 1]
    assert found.offset[0] == pytest.approx(places[chosen])
    assert found.reach[0] == pytest.approx(min(reach[chosen], 0.06))
    only_deep = place(at, least_reach=0.03)
    fit = np.flatnonzero(reach >= 0.03)
    assert only_deep.offset[0] == pytest.approx(places[fit[(len(fit) + 1) // 2 - 1]])


def test_no_place_is_found_between_points_that_are_too_close() -> None:
    close = [[0.0, 0.0, 0.0], *([x, 0.0, 0.0] for x in np.arange(-0.12, 0.125, 0.004))]
    assert not place(close).found[0]
    off = [[x, 0.02, z] for x, _, z in close]  # beside the hand's 1 cm
    assert place([[0.0, 0.0, 0.0], *off[1:]]).found[0]


def test_fingertips_stay_above_the_plane() -> None:
    found = place([[0.0, 0.0, 0.0]], Plane((0.0, 0.0, 1.0), -0.03))
    assert found.reach[0] == pytest.approx(0.03 - 0.003)
    assert not place([[0.0, 0.0, 0.0]], Plane((0.0, 0.0, 1.0), -0.012)).found[0]


# Candidates


def bodies_of(gripper: Gripper, margin: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """The grown boxes of palm and fingers, written down independently of the collision check."""
    w, d, h, t = gripper.width / 2, gripper.depth, gripper.height / 2 + margin, gripper.thickness
    return [
        (np.array([-gripper.palm_depth - margin, -w - t - margin, -h]), np.array([margin, w + t + margin, h])),
        (np.array([margin, w, -h]), np.array([d + margin, w + t + margin, h])),
        (np.array([margin, -w - t - margin, -h]), np.array([d + margin, -w, h])),
    ]


def test_candidates_hit_nothing_and_hold_something(scene: Scene) -> None:
    found = sample(scene)
    assert len(found.rotation) == 100 and found.tried >= 100
    assert scene.plane is not None
    limits, seen = CollisionConfig(), scene.objects.points[scene.objects.observed]
    corners = np.concatenate([box.corners() for box in GRIPPER.bodies()])
    for rotation, centre in zip(found.rotation, found.translation, strict=True):
        own = (scene.obstacles - centre) @ rotation
        for low, high in bodies_of(GRIPPER, limits.margin):
            inside = ((own > low + 1e-9) & (own < high - 1e-9)).all(axis=1).sum()
            assert inside <= limits.max_points
        assert scene.plane.height(corners @ rotation.T + centre).min() >= limits.table_clearance - 1e-9
        own = (seen - centre) @ rotation
        region = GRIPPER.closing_region()
        assert ((own > region.lower) & (own < region.upper)).all(axis=1).any()
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1.0)


def test_the_same_seed_gives_the_same_candidates(scene: Scene) -> None:
    first, same, other = sample(scene, 1), sample(scene, 1), sample(scene, 2)
    np.testing.assert_array_equal(first.rotation, same.rotation)
    np.testing.assert_array_equal(first.translation, same.translation)
    assert not np.array_equal(first.translation, other.translation)


def test_candidates_are_spread_over_the_scene(scene: Scene) -> None:
    """They come from many of the surface points, not from all hands of the first ones."""
    found = sample(scene)
    assert len(np.unique(found.rotation[:, :, 2].round(6), axis=0)) > 60


def test_only_the_focus_is_sampled(scene: Scene) -> None:
    nothing = np.zeros(len(scene.objects.points), bool)
    none = GpgSampler().sample(scene, GRIPPER, nothing, np.random.default_rng(0))
    assert len(none.rotation) == 0 and none.tried == 0
    hidden = ~scene.objects.observed
    assert hidden.any()
    assert GpgSampler().sample(scene, GRIPPER, hidden, np.random.default_rng(0)).tried == 0
    top = scene.objects.points[:, 2] > TABLE + 0.095
    found = GpgSampler().sample(scene, GRIPPER, top, np.random.default_rng(0))
    assert len(found.rotation) > 0
    # The surface point is in the plane of the fingers, between palm and fingertips.
    for rotation, centre in zip(found.rotation, found.translation, strict=True):
        own = (scene.objects.points[top] - centre) @ rotation
        assert ((np.abs(own[:, 2]) < 1e-9) & (own[:, 0] > 0) & (own[:, 0] < GRIPPER.depth)).any()


def test_an_object_that_is_wider_than_the_jaw_gives_fewer(scene: Scene) -> None:
    assert len(sample(scene, gripper=Gripper(width=0.03)).rotation) < 100


@pytest.mark.parametrize("wrong", [{"points": 0}, {"angles": 0}, {"neighbourhood": 0.0}, {"least_reach": -0.1}])
def test_impossible_numbers_are_refused(wrong: dict) -> None:
    with pytest.raises(InvalidInputError):
        GpgConfig(**wrong)
