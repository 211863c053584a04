"""The simulated gripper against cases with known answers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnet_core.data.objects.models import ObjectModel, build_mesh
from regnet_core.data.scenes.scene import TABLE_HEIGHT, Scene, default_table
from regnet_core.errors import GripperError, InvalidInputError
from regnet_core.geometry import Box
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.sim.config import SimConfig
from regnet_core.sim.outcome import Attempt, Outcome
from regnet_core.sim.simulator import GraspSimulator

GRIPPER = Gripper(width=0.08)
DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Columns: approach -z, closing +y, their cross product +x."""
SIDEWAYS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
LYING = DOWN
"""A rotation that lays an object's z axis along x."""


def _object(name: str, family: str, mass: float, **params: float) -> ObjectModel:
    mesh = build_mesh(family, params)
    return ObjectModel(name, family, params, mesh, (200, 0, 0), mass / float(mesh.volume), 0.5)


def _box(name: str, size: tuple[float, float, float], mass: float = 0.3) -> ObjectModel:
    return _object(name, "box", mass, x=size[0], y=size[1], z=size[2])


BRICK = _box("brick", (0.06, 0.04, 0.08))
CAN = _object("can", "can", 0.3, radius=0.033, height=0.12, chamfer=0.004)
ROLLER = _object("roller", "cylinder", 0.1, radius=0.03, height=0.12)
BALL = _object("ball", "superquadric", 0.1, x=0.03, y=0.03, z=0.03, e1=1.0, e2=1.0)


def _pose(x: float, y: float, above_table: float, rotation: np.ndarray | None = None) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, TABLE_HEIGHT + above_table
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose


def _scene(*placed: tuple[ObjectModel, np.ndarray], fixtures: tuple[Box, ...] = ()) -> Scene:
    poses = np.array([pose for _, pose in placed]).reshape(-1, 4, 4)
    return Scene(tuple(model for model, _ in placed), poses, default_table(), fixtures)


def _grasp(
    x: float, y: float, tips_above_table: float, rotation: np.ndarray = DOWN, width: float = GRIPPER.width
) -> Grasps:
    """A grasp whose fingertips end at a point."""
    tips = np.array([x, y, TABLE_HEIGHT + tips_above_table])
    one = np.ones(1)
    return Grasps(rotation[None], (tips - GRIPPER.depth * rotation[:, 0])[None], np.array([width]), one, one, one)


def _try(scene: Scene, grasp: Grasps, target: int | None = None, config: SimConfig | None = None) -> Attempt:
    return GraspSimulator(scene, GRIPPER, config).attempt(grasp, target)


BRICK_SCENE = _scene((BRICK, _pose(0.0, 0.0, 0.04)))
BRICK_GRASP = _grasp(0.0, 0.0, 0.04)
CAN_SCENE = _scene((CAN, _pose(0.0, 0.0, 0.06)))
CAN_GRASP = _grasp(0.0, 0.0, 0.09)


# Holding


def test_a_box_grasped_in_the_middle_is_held() -> None:
    attempt = _try(BRICK_SCENE, BRICK_GRASP, target=0)
    assert attempt.outcome is Outcome.HELD, attempt.message
    assert attempt.success
    assert attempt.lifted == (0,)
    assert attempt.opening == pytest.approx(0.04, abs=6e-4)
    assert attempt.slip < 1e-4


def test_a_can_of_300_grams_is_held() -> None:
    attempt = _try(CAN_SCENE, CAN_GRASP)
    assert attempt.outcome is Outcome.HELD, attempt.message
    assert attempt.opening == pytest.approx(0.066, abs=1e-3)
    assert attempt.slip < 2e-4


@pytest.mark.parametrize(("scene", "grasp"), [(BRICK_SCENE, BRICK_GRASP), (CAN_SCENE, CAN_GRASP)], ids=["box", "can"])
def test_what_is_held_does_not_creep_in_ten_seconds(scene: Scene, grasp: Grasps) -> None:
    attempt = _try(scene, grasp, config=SimConfig(hold_time=10.0))
    assert attempt.outcome is Outcome.HELD, attempt.message
    assert attempt.slip < 3e-4


@pytest.mark.parametrize("mass", [0.01, 1.0])
def test_light_and_heavy_boxes_are_held(mass: float) -> None:
    attempt = _try(_scene((_box("box", (0.06, 0.04, 0.08), mass), _pose(0.0, 0.0, 0.04))), BRICK_GRASP)
    assert attempt.outcome is Outcome.HELD, attempt.message


def test_a_thin_plate_is_held_with_the_full_force() -> None:
    attempt = _try(_scene((_box("plate", (0.06, 0.004, 0.06), 0.1), _pose(0.0, 0.0, 0.03))), _grasp(0.0, 0.0, 0.03))
    assert attempt.outcome is Outcome.HELD, attempt.message
    assert attempt.opening == pytest.approx(0.004, abs=6e-4)


def test_a_box_beside_the_middle_is_pushed_there_and_held() -> None:
    attempt = _try(BRICK_SCENE, _grasp(0.0, 0.012, 0.04))
    assert attempt.outcome is Outcome.HELD, attempt.message


def test_a_grasp_from_the_side_holds_a_can() -> None:
    attempt = _try(CAN_SCENE, _grasp(0.02, 0.0, 0.07, SIDEWAYS))
    assert attempt.outcome is Outcome.HELD, attempt.message


def test_the_approach_can_be_left_out() -> None:
    attempt = _try(BRICK_SCENE, BRICK_GRASP, config=SimConfig(pre_grasp_distance=0.0))
    assert attempt.outcome is Outcome.HELD, attempt.message


def test_both_descriptions_of_one_symmetric_grasp_come_to_the_same() -> None:
    turned = BRICK_GRASP.rotation[0] * [1.0, -1.0, -1.0]
    attempt = _try(BRICK_SCENE, _grasp(0.0, 0.0, 0.04, turned))
    assert attempt.outcome is Outcome.HELD, attempt.message


# Too heavy, too slippery, too oblique


@pytest.mark.parametrize(("mass", "expected"), [(1.1, Outcome.HELD), (1.3, Outcome.SLIPPED)])
def test_friction_limits_the_mass_that_is_held(mass: float, expected: Outcome) -> None:
    # Two pads carry at most 2 x 0.2 x 30 N = 12 N: 1.22 kg, when the hand hardly accelerates.
    config = SimConfig(pad_friction=0.2, lift_speed=0.05, shake_amplitude=0.0)
    attempt = _try(_scene((_box("box", (0.06, 0.04, 0.08), mass), _pose(0.0, 0.0, 0.04))), BRICK_GRASP, config=config)
    assert attempt.outcome is expected, attempt.message


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [(0.0, Outcome.HELD), (30.0, Outcome.HELD), (45.0, Outcome.SLIPPED), (60.0, Outcome.SLIPPED)],
)
def test_a_roller_is_held_within_the_friction_cone_only(degrees: float, expected: Outcome) -> None:
    # Fingertips above a lying cylinder's axis meet it at this angle; friction of 0.8 holds up to 38.7 degrees.
    scene = _scene((ROLLER, _pose(0.0, 0.0, 0.03, LYING)))
    attempt = _try(scene, _grasp(0.0, 0.0, 0.03 + 0.03 * np.sin(np.radians(degrees))))
    assert attempt.outcome is expected, attempt.message


def test_a_ball_grasped_near_its_edge_slips() -> None:
    scene = _scene((BALL, _pose(0.0, 0.0, 0.03)))
    held, lost = _try(scene, _grasp(0.0, 0.0, 0.025)), _try(scene, _grasp(0.026, 0.0, 0.025))
    assert held.outcome is Outcome.HELD, held.message
    assert lost.outcome in (Outcome.SLIPPED, Outcome.MISSED), lost.message
    assert lost.lifted == ()


# Missing and colliding


def test_a_grasp_in_the_air_misses() -> None:
    attempt = _try(CAN_SCENE, _grasp(0.0, 0.3, 0.05))
    assert attempt.outcome is Outcome.MISSED
    assert not attempt.success
    assert attempt.lifted == ()
    assert attempt.opening == pytest.approx(0.0, abs=1e-3)
    assert np.isnan(attempt.slip)


def test_an_empty_table_misses() -> None:
    assert _try(_scene(), _grasp(0.0, 0.0, 0.05)).outcome is Outcome.MISSED


def test_fingers_into_the_table_collide() -> None:
    attempt = _try(CAN_SCENE, _grasp(0.0, 0.3, -0.005))
    assert attempt.outcome is Outcome.COLLISION
    assert "table" in attempt.message


def test_the_palm_on_an_object_collides() -> None:
    attempt = _try(CAN_SCENE, _grasp(0.0, 0.0, 0.12 - GRIPPER.depth - 0.01))
    assert attempt.outcome is Outcome.COLLISION
    assert "palm touched object 0" in attempt.message


def test_a_jaw_narrower_than_the_object_collides() -> None:
    attempt = _try(CAN_SCENE, _grasp(0.0, 0.0, 0.09, width=0.05))
    assert attempt.outcome is Outcome.COLLISION
    assert "touched object 0" in attempt.message


def test_pushing_a_light_object_away_is_a_collision() -> None:
    scene = _scene((_box("light", (0.03, 0.03, 0.03), 0.01), _pose(0.0, 0.0, 0.015)))
    attempt = _try(scene, _grasp(0.03, 0.04, 0.015, SIDEWAYS))  # one finger sweeps the box along
    assert attempt.outcome is Outcome.COLLISION
    assert "pushed" in attempt.message


def test_a_fixture_in_the_way_collides() -> None:
    wall = Box((-0.1, 0.03, TABLE_HEIGHT), (0.1, 0.06, TABLE_HEIGHT + 0.1))
    scene = _scene((BRICK, _pose(0.0, 0.0, 0.04)), fixtures=(wall,))
    attempt = _try(scene, BRICK_GRASP)
    assert attempt.outcome is Outcome.COLLISION
    assert "fixture" in attempt.message


def test_a_start_inside_an_object_collides_at_once() -> None:
    attempt = _try(CAN_SCENE, _grasp(0.2, 0.0, 0.05, SIDEWAYS))  # the pre-grasp is 0.1 m back, at the can
    assert attempt.outcome is Outcome.COLLISION
    assert attempt.duration < 0.01


# Which objects


def test_another_object_than_the_target_is_the_wrong_one() -> None:
    scene = _scene((CAN, _pose(0.0, 0.2, 0.06)), (BRICK, _pose(0.0, 0.0, 0.04)))
    attempt = _try(scene, BRICK_GRASP, target=0)
    assert attempt.outcome is Outcome.WRONG_OBJECT
    assert not attempt.success
    assert attempt.lifted == (1,)


def test_two_thin_objects_between_the_fingers_are_several() -> None:
    slabs = [_box(name, (0.06, 0.015, 0.08), 0.1) for name in ("left", "right")]
    scene = _scene((slabs[0], _pose(0.0, 0.0076, 0.04)), (slabs[1], _pose(0.0, -0.0076, 0.04)))
    attempt = _try(scene, BRICK_GRASP, target=0)
    assert attempt.outcome is Outcome.SEVERAL, attempt.message
    assert attempt.lifted == (0, 1)


def test_an_object_on_top_of_the_lifted_one_makes_several() -> None:
    coin = _box("coin", (0.02, 0.02, 0.01), 0.02)
    scene = _scene((BRICK, _pose(0.0, 0.0, 0.04)), (coin, _pose(0.0, 0.0, 0.085)))
    attempt = _try(scene, _grasp(0.0, 0.0, 0.04, SIDEWAYS), config=SimConfig(shake_amplitude=0.005))
    assert attempt.outcome is Outcome.SEVERAL, attempt.message


# State


def test_the_same_attempt_comes_to_exactly_the_same() -> None:
    simulator = GraspSimulator(_scene((CAN, _pose(0.0, 0.0, 0.06)), (BRICK, _pose(0.0, 0.07, 0.04))), GRIPPER)
    first = simulator.attempt(CAN_GRASP)
    poses = simulator.poses()
    simulator.attempt(_grasp(0.0, 0.07, 0.04, width=0.05))
    again = simulator.attempt(CAN_GRASP)
    assert (again.outcome, again.opening, again.slip) == (first.outcome, first.opening, first.slip)
    np.testing.assert_array_equal(simulator.poses(), poses)
    fresh = GraspSimulator(simulator.scene, GRIPPER)
    assert fresh.attempt(CAN_GRASP).slip == first.slip
    np.testing.assert_array_equal(fresh.poses(), poses)


def test_a_reset_puts_every_object_back() -> None:
    simulator = GraspSimulator(CAN_SCENE, GRIPPER)
    simulator.attempt(CAN_GRASP)
    assert simulator.poses()[0, 2, 3] > CAN_SCENE.poses[0, 2, 3] + 0.19
    simulator.reset()
    np.testing.assert_allclose(simulator.poses(), CAN_SCENE.poses, atol=1e-12)


def test_objects_that_nobody_touches_stay_exactly_where_they_are() -> None:
    scene = _scene((CAN, _pose(0.0, 0.2, 0.06)), (BRICK, _pose(0.0, 0.0, 0.04)))
    simulator = GraspSimulator(scene, GRIPPER)
    assert simulator.attempt(BRICK_GRASP).success
    np.testing.assert_allclose(simulator.poses()[0], scene.poses[0], atol=1e-12)


def test_an_episode_clears_the_table() -> None:
    # The brick stands on a slab: once the brick is gone, the slab can be taken.
    slab = _box("slab", (0.12, 0.05, 0.04), 0.3)
    scene = _scene((slab, _pose(0.0, 0.0, 0.02)), (BRICK, _pose(0.0, 0.0, 0.08)))
    simulator = GraspSimulator(scene, GRIPPER)
    assert simulator.attempt(_grasp(0.0, 0.0, 0.085), target=1, reset=False).success
    simulator.remove(1)
    assert simulator.settle()
    assert simulator.remaining == (0,)
    np.testing.assert_allclose(simulator.poses()[0], scene.poses[0], atol=2e-4)
    assert simulator.attempt(_grasp(0.0, 0.0, 0.01), target=0, reset=False).success
    simulator.remove(0)
    assert simulator.remaining == ()
    simulator.reset()
    assert simulator.remaining == (0, 1)


def test_what_rested_on_a_removed_object_falls() -> None:
    slab = _box("slab", (0.12, 0.05, 0.04), 0.3)
    simulator = GraspSimulator(_scene((slab, _pose(0.0, 0.0, 0.02)), (BRICK, _pose(0.0, 0.0, 0.08))), GRIPPER)
    simulator.remove(0)
    assert simulator.settle()
    assert simulator.poses()[1, 2, 3] == pytest.approx(TABLE_HEIGHT + 0.04, abs=1e-3)


def test_what_is_held_falls_when_the_hand_goes() -> None:
    simulator = GraspSimulator(BRICK_SCENE, GRIPPER)
    assert simulator.attempt(BRICK_GRASP).success
    assert simulator.settle()
    assert simulator.poses()[0, 2, 3] < TABLE_HEIGHT + 0.05


def test_what_falls_off_the_table_is_removed() -> None:
    scene = _scene((BRICK, _pose(0.0, 0.0, 0.04)), (CAN, _pose(0.6, 0.0, 0.06)))
    simulator = GraspSimulator(scene, GRIPPER)
    simulator.remove(0)  # wakes the can, which stands beside the table
    assert simulator.settle()
    assert simulator.remaining == ()


def test_a_recording_follows_the_hand_and_the_object() -> None:
    recording = GraspSimulator(BRICK_SCENE, GRIPPER).attempt(BRICK_GRASP, record_every=0.1).recording
    assert recording is not None
    np.testing.assert_allclose(np.diff(recording.time), 0.1)
    assert recording.object_poses.shape == (len(recording.time), 1, 4, 4)
    assert recording.opening[0] == pytest.approx(0.08, abs=1e-4)
    start = BRICK_GRASP.translation[0] + [0.0, 0.0, 0.1]
    np.testing.assert_allclose(recording.hand_poses[0, :3, 3], start, atol=1e-3)
    end = BRICK_GRASP.translation[0] + [0.0, 0.0, 0.2]
    np.testing.assert_allclose(recording.hand_poses[-1, :3, 3], end, atol=1e-3)
    np.testing.assert_allclose(recording.hand_poses[:, :3, :3] - DOWN, 0.0, atol=1e-9)


# Bad input


def test_bad_grasps_are_refused() -> None:
    simulator = GraspSimulator(BRICK_SCENE, GRIPPER)
    with pytest.raises(InvalidInputError, match=r"exactly one grasp.*got 2 grasps"):
        simulator.attempt(Grasps.concatenate([BRICK_GRASP, BRICK_GRASP]))
    with pytest.raises(InvalidInputError, match=r"exactly one grasp.*got 0 grasps"):
        simulator.attempt(Grasps.empty())
    with pytest.raises(GripperError, match=r"opening must be in \(0, 0.08\]"):
        simulator.attempt(_grasp(0.0, 0.0, 0.04, width=0.1))
    with pytest.raises(InvalidInputError, match="rotation matrix"):
        simulator.attempt(_grasp(0.0, 0.0, 0.04, 2.0 * DOWN))
    with pytest.raises(InvalidInputError, match="translation must be finite"):
        simulator.attempt(_grasp(float("nan"), 0.0, 0.04))


def test_bad_objects_are_refused() -> None:
    simulator = GraspSimulator(BRICK_SCENE, GRIPPER)
    for target in (1, -1, True, 0.0):
        with pytest.raises(InvalidInputError, match=r"target must be the index .* \[0\], got"):
            simulator.attempt(BRICK_GRASP, target)  # type: ignore[arg-type]
    simulator.remove(0)
    with pytest.raises(InvalidInputError, match=r"index must be .* \[\], got 0"):
        simulator.remove(0)


@pytest.mark.parametrize(("name", "value"), [("timestep", 0.0), ("grip_force", -1.0), ("lift_height", float("nan"))])
def test_bad_constants_are_refused(name: str, value: float) -> None:
    with pytest.raises(InvalidInputError, match=f"{name} must be"):
        SimConfig(**{name: value})


def test_a_thin_bar_gripped_askew_is_held_and_has_turned() -> None:
    bar = _box("bar", (0.16, 0.012, 0.05), mass=0.1)
    scene = _scene((bar, _pose(0.0, 0.0, 0.025)))
    askew = Rotation.from_euler("z", 1.0).as_matrix() @ DOWN
    straight, turned = (_try(scene, _grasp(0.0, 0.0, 0.01, rotation), target=0) for rotation in (DOWN, askew))
    assert straight.success and straight.turn < 0.02
    assert turned.success and turned.turn == pytest.approx(1.0, abs=0.1)
