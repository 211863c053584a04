"""How attempts are judged: every class of failure on constructed evidence, and in physics with hand-made grasps."""

import itertools
import math

import numpy as np
import pytest

from regnet_core.data.objects.models import ObjectModel, build_mesh
from regnet_core.data.scenes.scene import Scene
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.picking.failures import Evidence, Failure, judge
from regnet_core.picking.robot import PickAttempt, PickRobot
from regnet_core.picking.snapshot import Snapshot
from regnet_core.picking.workcell import Workcell, bin_workcell, table_workcell
from regnet_core.sim.config import SimConfig
from regnet_core.sim.simulator import GraspSimulator

GRIPPER = Gripper(width=0.08)
DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Columns: approach -z, closing +y, their cross product +x."""
FORWARD = np.eye(3)
"""Approach +x, closing +y."""
BIN = bin_workcell()
FLOOR = BIN.pick_bin.inside.lower[2] if BIN.pick_bin else 0.0
GRIP = ((0,), (0,))


def _evidence(**changes: object) -> Evidence:
    fields: dict[str, object] = {
        "placed": (0,),
        "lifted": (0,),
        "gripped": GRIP,
        "opening": 0.08,
        "closed_to": 0.04,
        "between": 0,
        "extent": 0.04,
    }
    return Evidence(**{**fields, **changes})  # type: ignore[arg-type]


# Constructed evidence


def test_one_object_placed_is_a_success_even_after_a_touch() -> None:
    assert judge(_evidence()).success
    verdict = judge(_evidence(contact="the palm touched object 3 with 7 N, 0.010 m before the grasp"))
    assert verdict.success and "object 0 was placed, held 0.040 m wide, though the palm touched" in verdict.message


@pytest.mark.parametrize(
    ("changes", "failure", "words"),
    [
        ({"placed": (0, 2)}, Failure.SEVERAL, "objects 0 and 2 were taken together, 2 of them placed"),
        ({"lifted": (0, 1), "placed": ()}, Failure.SEVERAL, "objects 0 and 1 were taken together, 0 of them placed"),
        ({"lifted": (1,)}, Failure.SEVERAL, "objects 0 and 1"),  # another one came up than was placed
        ({"placed": (), "lifted": (), "extent": 0.0905}, Failure.GRIPPER_LIMIT, "0.090 m wide .* open by 0.080 m"),
        (
            {"placed": (), "lifted": (), "extent": 0.09, "contact": "a finger touched object 0", "stopped": True},
            Failure.GRIPPER_LIMIT,
            "object 0 is 0.090 m",
        ),
        (
            {"placed": (), "lifted": (), "contact": "a finger touched object 3", "stopped": True, "gripped": ((), ())},
            Failure.COLLISION,
            "a finger touched object 3; the approach was given up",
        ),
        (
            {"placed": (), "lifted": (), "contact": "object 3 was pushed", "lost": "0.120 m above the grasp"},
            Failure.COLLISION,
            "object 3 was pushed; object 0, gripped 0.040 m wide, was lost 0.120 m above",
        ),
        (
            {"placed": (), "lifted": (), "gripped": ((3,), (5,)), "lost": "0.010 m above the grasp"},
            Failure.SEVERAL,
            "the fingers closed to 0.040 m on objects 3 and 5; .* lost 0.010 m above the grasp",
        ),
        (
            {"placed": (), "lost": "on the way to the place, 0.300 m before it"},
            Failure.UNSTABLE,
            "object 0, gripped 0.040 m wide, was lost on the way to the place, 0.300 m before it",
        ),
        ({"placed": ()}, Failure.UNSTABLE, "released and came to rest beside the place bin"),
        ({"placed": (), "lifted": ()}, Failure.UNSTABLE, "was not lifted"),
        (
            {"placed": (), "lifted": (), "gripped": ((), ()), "closed_to": -0.0002, "between": None, "blocked": True},
            Failure.UNSTABLE,
            "closed to 0.000 m on no object, one against the table or a bin",
        ),
        (
            {"placed": (), "lifted": (), "gripped": ((), (4,)), "closed_to": 0.03},
            Failure.UNSTABLE,
            "closed to 0.030 m, only one of them on object 4",
        ),
    ],
)
def test_the_first_class_that_applies_is_given(changes: dict[str, object], failure: Failure, words: str) -> None:
    verdict = judge(_evidence(**changes))
    assert verdict.failure is failure and not verdict.success
    import re

    assert re.search(words, verdict.message), verdict.message


def test_every_attempt_has_exactly_one_outcome_and_a_message() -> None:
    found = set()
    for placed, lifted, gripped, contact, lost, extent in itertools.product(
        [(), (0,), (0, 1)],
        [(), (0,), (1,), (0, 1)],
        [((), ()), ((0,), ()), GRIP, ((0,), (1,))],
        [None, "a finger touched object 1"],
        [None, "somewhere"],
        [math.nan, 0.04, 0.081, 0.09],
    ):
        verdict = judge(
            _evidence(placed=placed, lifted=lifted, gripped=gripped, contact=contact, lost=lost, extent=extent)
        )
        one_placed = len(placed) == 1 and set(lifted) <= set(placed)
        assert verdict.success == one_placed
        assert verdict.message and verdict.message[-1] != "." and any(sign.isdigit() for sign in verdict.message)
        found.add(verdict.failure)
    assert found == {None, *Failure}


def test_an_object_hardly_wider_than_the_opening_may_have_gone_in() -> None:
    gone_in = judge(_evidence(placed=(), lifted=(), extent=0.0805))
    assert gone_in.failure is Failure.UNSTABLE


# Physics


def _box(name: str, size: tuple[float, float, float], mass: float = 0.2) -> ObjectModel:
    params = dict(zip("xyz", size, strict=True))
    mesh = build_mesh("box", params)
    return ObjectModel(name, "box", params, mesh, (200, 0, 0), mass / float(mesh.volume), 0.5)


def _scene(cell: Workcell, *placed: tuple[ObjectModel, tuple[float, float, float]]) -> Scene:
    poses = np.tile(np.eye(4), (len(placed), 1, 1))
    poses[:, :3, 3] = [position for _, position in placed]
    return Scene(tuple(model for model, _ in placed), poses, cell.table, cell.obstacles)


def _grasp(tips: tuple[float, float, float], rotation: np.ndarray = DOWN, width: float = 0.08) -> Grasps:
    """A grasp whose fingertips end at a point."""
    one = np.ones(1)
    origin = np.array(tips) - GRIPPER.depth * rotation[:, 0]
    return Grasps(rotation[None], origin[None], np.array([width]), one, one, one)


def _try(cell: Workcell, scene: Scene, grasp: Grasps, physics: SimConfig | None = None) -> PickAttempt:
    return PickRobot(scene, cell, GRIPPER, physics).try_grasp(Snapshot.of(scene.poses), grasp)


CUBE = _box("cube", (0.05, 0.05, 0.05))
CUBE_SCENE = _scene(BIN, (CUBE, (0.05, 0.02, FLOOR + 0.025)))
CUBE_GRASP = _grasp((0.05, 0.02, FLOOR + 0.01))


def test_a_cube_alone_in_the_bin_is_placed_and_taken_away() -> None:
    robot = PickRobot(CUBE_SCENE, BIN, GRIPPER)
    attempt = robot.try_grasp(Snapshot.of(CUBE_SCENE.poses), CUBE_GRASP, record_every=0.05)
    assert attempt.verdict.success, attempt.verdict.message
    assert attempt.placed == (0,) and attempt.record.lifted == (0,) and attempt.record.contact is None
    assert attempt.record.opening == pytest.approx(0.05, abs=6e-4)
    assert attempt.after.removed == (0,)
    moments = attempt.record.moments
    assert list(moments) == ["before", "at the grasp", "closed", "lifted", "above the place", "released"]
    assert list(moments.values()) == sorted(moments.values())
    recording = attempt.record.recording
    assert recording is not None
    at = np.abs(recording.time - moments["lifted"]).argmin()
    assert recording.object_poses[at, 0, 2, 3] == pytest.approx(FLOOR + 0.025 + 0.35, abs=0.003)
    x, y = BIN.place
    at = np.abs(recording.time - moments["above the place"]).argmin()
    np.testing.assert_allclose(recording.object_poses[at, 0, :2, 3], [x, y], atol=0.005)
    # It was let go, and lies on the floor of the place bin.
    assert BIN.placed(recording.object_poses[-1])[0]
    assert recording.object_poses[-1, 0, 2, 3] < BIN.place_bin.inside.lower[2] + 0.05


def test_a_tilted_grasp_places_too() -> None:
    c, s = np.cos(0.6), np.sin(0.6)
    tilted = np.stack([[s, 0.0, -c], [0.0, 1.0, 0.0], [c, 0.0, s]], axis=1)
    attempt = _try(BIN, CUBE_SCENE, _grasp((0.05, 0.02, FLOOR + 0.012), tilted))
    assert attempt.verdict.success, attempt.verdict.message


def test_two_boxes_that_touch_are_more_than_one_object() -> None:
    slabs = [_box(name, (0.06, 0.02, 0.05), 0.1) for name in ("left", "right")]
    scene = _scene(BIN, (slabs[0], (0.0, 0.0101, FLOOR + 0.025)), (slabs[1], (0.0, -0.0101, FLOOR + 0.025)))
    attempt = _try(BIN, scene, _grasp((0.0, 0.0, FLOOR + 0.01)))
    assert attempt.verdict.failure is Failure.SEVERAL, attempt.verdict.message
    assert "objects 0 and 1" in attempt.verdict.message
    assert attempt.placed == (0, 1) and attempt.after.removed == (0, 1)


def test_a_box_wider_than_the_jaw_is_its_limit() -> None:
    scene = _scene(BIN, (_box("wide", (0.06, 0.1, 0.05)), (0.0, 0.0, FLOOR + 0.025)))
    attempt = _try(BIN, scene, _grasp((0.0, 0.0, FLOOR + 0.01)))
    assert attempt.verdict.failure is Failure.GRIPPER_LIMIT, attempt.verdict.message
    assert "0.100 m wide" in attempt.verdict.message and "0.080 m" in attempt.verdict.message
    assert attempt.record.stopped and attempt.placed == () and attempt.after.removed == ()


def test_a_finger_on_a_box_that_would_fit_is_a_collision() -> None:
    attempt = _try(BIN, CUBE_SCENE, _grasp((0.05, 0.05, FLOOR + 0.01)))
    assert attempt.verdict.failure is Failure.COLLISION, attempt.verdict.message
    assert "touched object 0 with" in attempt.verdict.message and "given up" in attempt.verdict.message
    assert list(attempt.record.moments) == ["before", "given up"]


def test_a_wall_in_the_way_is_a_collision() -> None:
    attempt = _try(BIN, CUBE_SCENE, _grasp((0.0, 0.16, FLOOR + 0.01)))  # the finger at +Y ends 0.205 m from the middle
    assert attempt.verdict.failure is Failure.COLLISION, attempt.verdict.message
    assert "the table or a fixture" in attempt.verdict.message


def test_closing_on_nothing_is_unstable() -> None:
    attempt = _try(BIN, CUBE_SCENE, _grasp((-0.1, 0.0, FLOOR + 0.01)))
    assert attempt.verdict.failure is Failure.UNSTABLE, attempt.verdict.message
    assert "on no object" in attempt.verdict.message
    np.testing.assert_allclose(attempt.after.poses(), CUBE_SCENE.poses, atol=1e-6)


def test_what_slips_out_is_unstable_and_stays() -> None:
    heavy = _scene(BIN, (_box("heavy", (0.05, 0.05, 0.05), 1.0), (0.05, 0.02, FLOOR + 0.025)))
    attempt = _try(BIN, heavy, CUBE_GRASP, SimConfig(pad_friction=0.1))  # carries 2 x 0.1 x 30 N = 6 N of 9.8 N
    assert attempt.verdict.failure is Failure.UNSTABLE, attempt.verdict.message
    assert attempt.after.removed == () and BIN.to_pick(attempt.after.poses()).all()


def test_a_light_thing_that_is_swept_aside_does_not_spoil_a_success() -> None:
    cell = table_workcell()
    top = cell.table.upper[2]
    target, crumb = _box("target", (0.05, 0.04, 0.08)), _box("crumb", (0.02, 0.02, 0.03), 0.01)
    scene = _scene(cell, (target, (0.0, 0.0, top + 0.04)), (crumb, (-0.05, 0.048, top + 0.015)))
    attempt = _try(cell, scene, _grasp((0.01, 0.0, top + 0.02), FORWARD))
    assert attempt.verdict.success, attempt.verdict.message
    assert attempt.record.contact is not None and "object 1 was pushed" in attempt.record.contact
    assert "though object 1 was pushed" in attempt.verdict.message


# The same again


def test_an_attempt_depends_on_nothing_that_was_before() -> None:
    scene = _scene(
        BIN, (CUBE, (0.05, 0.02, FLOOR + 0.025)), (_box("other", (0.04, 0.04, 0.06)), (-0.1, 0.0, FLOOR + 0.03))
    )
    robot, before = PickRobot(scene, BIN, GRIPPER), Snapshot.of(scene.poses)
    first = robot.try_grasp(before, CUBE_GRASP)
    second = robot.try_grasp(first.after, _grasp((-0.1, 0.0, FLOOR + 0.02)))
    assert first.verdict.success and second.verdict.success and second.after.removed == (0, 1)
    for other in (robot, PickRobot(scene, BIN, GRIPPER)):
        again = other.try_grasp(first.after, _grasp((-0.1, 0.0, FLOOR + 0.02)))
        assert (again.verdict, again.after) == (second.verdict, second.after)
        assert again.record.opening == second.record.opening and again.record.moments == second.record.moments


def test_a_restart_is_a_fresh_scene() -> None:
    poses = CUBE_SCENE.poses.copy()
    poses[0, :2, 3] = -0.08, 0.03
    moved = Scene(CUBE_SCENE.objects, poses, CUBE_SCENE.table, CUBE_SCENE.fixtures)
    fresh, used = GraspSimulator(moved, GRIPPER), GraspSimulator(CUBE_SCENE, GRIPPER)
    used.attempt(CUBE_GRASP)
    used.restart(poses)
    np.testing.assert_array_equal(used.poses(), fresh.poses())
    grasp = _grasp((-0.08, 0.03, FLOOR + 0.01))
    one, other = fresh.attempt(grasp, reset=False), used.attempt(grasp, reset=False)
    assert (one.outcome, one.slip, one.opening) == (other.outcome, other.slip, other.opening)
    used.reset()
    np.testing.assert_allclose(used.poses(), CUBE_SCENE.poses, atol=1e-12)
    used.restart(poses, removed=(0,))
    assert used.remaining == ()


def test_a_snapshot_goes_through_a_file_exactly() -> None:
    import json

    from regnet_core.picking.records import recorded_state

    rng = np.random.default_rng(3)
    from scipy.spatial.transform import Rotation

    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = Rotation.random(4, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(4, 3))
    state = Snapshot.of(poses, {2})
    assert state.removed == (2,) and state.remaining == (0, 1, 3)
    np.testing.assert_allclose(state.poses()[[0, 1, 3]], poses[[0, 1, 3]], atol=1e-8)
    rows = json.loads(json.dumps([row and list(row) for row in state.rows]))
    assert recorded_state(rows) == state
    np.testing.assert_array_equal(recorded_state(rows).poses(), state.poses())
