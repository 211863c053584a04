"""The work cell: a robot picks what it can, says what went wrong where it cannot, and always comes home."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from regnet_core.data.objects.models import ObjectModel, build_mesh
from regnet_core.data.scenes.scene import Scene
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, pose_matrix, transform_points
from regnet_core.gripper import Gripper
from regnet_core.robots import layout
from regnet_core.robots.cell import CellConfig, WorkCell
from regnet_core.robots.cell_state import restore_state, save_state
from regnet_core.robots.goal import GraspGoal
from regnet_core.robots.layout import CellLayout, fill
from regnet_core.robots.model import PREFIX, ROBOTS, get_robot
from regnet_core.robots.names import ROBOT_NAMES
from regnet_core.robots.picking import Phase, PickOutcome
from regnet_core.sim.config import SimConfig

LAYOUT = CellLayout()
FLOOR = LAYOUT.pick_bin.inside.lower[2]
GRIPPER = Gripper()
MIDDLE = np.array(LAYOUT.pick)


def brick(
    name: str = "brick", size: tuple[float, float, float] = (0.05, 0.03, 0.06), friction: float = 0.5
) -> ObjectModel:
    params = dict(zip("xyz", size, strict=True))
    mesh = build_mesh("box", params)
    return ObjectModel(name, "box", params, mesh, (200, 0, 0), 0.1 / float(mesh.volume), friction)


def scene(*objects: tuple[ObjectModel, float, float]) -> Scene:
    """Objects that stand in the bin to pick from, at x and y from its middle."""
    poses = np.tile(np.eye(4), (len(objects), 1, 1))
    for pose, (model, x, y) in zip(poses, objects, strict=True):
        pose[:3, 3] = [*np.add(MIDDLE, [x, y]), FLOOR - model.mesh.bounds[0, 2]]
    return Scene(tuple(model for model, _, _ in objects), poses, LAYOUT.table, LAYOUT.fixtures)


def goal(x: float, y: float, height: float, opening: float = 0.06, tilt: float = 0.0) -> GraspGoal:
    """From above, closing along y, the fingertips at a height above the bin's floor; tilted about y [rad]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", tilt).as_matrix() @ [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    T[:3, 3] = [*np.add(MIDDLE, [x, y]), FLOOR + height] - GRIPPER.depth * T[:3, 0]
    before, up = T.copy(), T.copy()
    before[:3, 3] -= 0.1 * T[:3, 0]
    up[2, 3] += 0.1
    return GraspGoal(before, T, up, opening)


def is_home(cell: WorkCell) -> bool:
    return bool(np.abs(cell.physics.q() - cell.robot.home).max() < 0.02)


@pytest.fixture(scope="module", params=["baxter", "panda"])
def cell(request: pytest.FixtureRequest) -> WorkCell:
    """Two bricks, the second one off the middle."""
    return WorkCell(CellConfig(request.param), scene((brick("one"), 0.0, 0.0), (brick("two"), 0.08, 0.06)))


@pytest.fixture
def fresh(cell: WorkCell) -> WorkCell:
    """The same cell with the bricks where they began."""
    cell.restore(cell.scene.poses)
    return cell


def test_a_brick_is_picked_and_placed(fresh: WorkCell) -> None:
    seen: list[tuple[Phase, float]] = []

    def watch(phase: Phase, progress: float) -> bool:
        seen.append((phase, progress))
        return True

    assert (fresh.to_pick, fresh.placed) == ((0, 1), ())
    result = fresh.pick(goal(0.0, 0.0, 0.02), watch)
    assert result.outcome is PickOutcome.PLACED and result.success, result.message
    assert result.disturbed and 2.0 < result.duration < 30.0
    assert (fresh.to_pick, fresh.placed) == ((1,), (0,))
    assert list(dict.fromkeys(phase for phase, _ in seen)) == list(Phase)
    progress = [share for _, share in seen]
    assert progress == sorted(progress) and progress[0] == 0.0 and progress[-1] < 1.0
    assert is_home(fresh)
    assert fresh.poses()[1] == pytest.approx(fresh.scene.poses[1], abs=2e-3)  # the other one was left alone


def test_the_bin_is_emptied_object_by_object(fresh: WorkCell) -> None:
    assert fresh.pick(goal(0.08, 0.06, 0.02)).success
    assert fresh.pick(goal(0.0, 0.0, 0.02)).success
    assert (fresh.to_pick, set(fresh.placed)) == ((), {0, 1})


def test_a_grasp_of_nothing_is_missed_and_disturbs_nothing(fresh: WorkCell) -> None:
    result = fresh.pick(goal(-0.08, -0.05, 0.02))
    assert result.outcome is PickOutcome.MISSED and "holds nothing" in result.message
    assert not result.disturbed and not result.success
    assert is_home(fresh) and fresh.physics.opening() == pytest.approx(GRIPPER.width, abs=1e-3)


def test_an_unreachable_grasp_does_not_move_the_robot(fresh: WorkCell) -> None:
    before = fresh.physics.time
    far = goal(1.5, 0.0, 0.02)
    assert "does not reach" in fresh.check(far)
    result = fresh.pick(far)
    assert result.outcome is PickOutcome.UNREACHABLE and result.message.startswith("unreachable: ")
    assert fresh.physics.time == before and not result.disturbed


def test_a_grasp_in_the_wall_of_the_bin_is_unreachable(fresh: WorkCell) -> None:
    beside = goal(0.0, 0.115, 0.03)  # a finger 3 to 4 cm from the middle of the jaw is in the wall
    assert "hand touches the table or an obstacle" in fresh.check(beside)
    assert fresh.pick(beside).outcome is PickOutcome.UNREACHABLE
    assert fresh.check(goal(0.0, 0.115, 0.03, opening=0.04)) == ""  # and is not where the jaw opens less
    assert fresh.check(goal(0.0, 0.0, 0.02)) == ""


def test_the_jaw_does_not_close_on_a_wall(fresh: WorkCell) -> None:
    """Astride the wall there would be room for the fingers, and something to grip."""
    assert fresh.check(goal(0.0, 0.155, 0.05)) == "a part of a bin is between the fingers"


def test_the_arm_stops_when_the_hand_presses_on_something(fresh: WorkCell) -> None:
    """Too narrow an opening: the fingers come down on the brick."""
    result = fresh.pick(goal(0.0, 0.0, 0.02, opening=0.02))
    assert result.outcome is PickOutcome.COLLISION, result.message
    assert "pressed on one with" in result.message
    assert is_home(fresh)
    assert fresh.pick(goal(0.08, 0.06, 0.02)).success  # and works on


def test_a_slippery_brick_is_dropped_on_the_way() -> None:
    """Gripped by its edge with hardly any friction, it is lost."""
    config = CellConfig("panda", sim=SimConfig(timestep=0.002, pad_friction=0.02, pad_torsion=0.0, grip_force=5.0))
    cell = WorkCell(config, scene((brick(size=(0.05, 0.03, 0.06)), 0.0, 0.0)))
    result = cell.pick(goal(0.0, 0.0, 0.05))
    assert result.outcome is PickOutcome.DROPPED and "lost what it held" in result.message
    assert cell.to_pick == (0,) and is_home(cell)


@pytest.mark.parametrize("when", [Phase.PRE_GRASP, Phase.CLOSE, Phase.PLACE])
def test_a_cancelled_pick_ends_at_home_with_an_open_jaw(fresh: WorkCell, when: Phase) -> None:
    result = fresh.pick(goal(0.0, 0.0, 0.02), lambda phase, progress: phase is not when)
    assert result.outcome is PickOutcome.CANCELLED and when.value in result.message
    assert is_home(fresh) and fresh.physics.opening() == pytest.approx(GRIPPER.width, abs=1e-3)
    if when is not Phase.PLACE:
        assert not result.disturbed
    fresh.restore(fresh.scene.poses)
    assert fresh.pick(goal(0.0, 0.0, 0.02)).success


def test_a_tilted_grasp_is_executed_as_well(fresh: WorkCell) -> None:
    assert fresh.pick(goal(0.0, 0.0, 0.03, tilt=np.radians(20.0))).success


def test_an_opening_that_the_jaw_does_not_have_is_refused(fresh: WorkCell) -> None:
    with pytest.raises(InvalidInputError, match=r"opening must be in \(0, 0.08\] m, got 0.1"):
        fresh.pick(goal(0.0, 0.0, 0.02, opening=0.1))


def test_the_camera_sees_the_bricks_and_the_bin_alone(fresh: WorkCell) -> None:
    points, colours = fresh.capture()
    assert points.shape == colours.shape and len(points) > 5000 and colours.dtype == np.uint8
    world = transform_points(LAYOUT.camera.T_world_camera, points)
    assert LAYOUT.view.contains(world).mean() > 0.999
    top = world[(np.abs(world[:, :2] - MIDDLE) < [0.02, 0.01]).all(axis=1)]
    assert np.median(top[:, 2]) == pytest.approx(FLOOR + 0.06, abs=0.004)
    again, _ = fresh.capture()
    assert len(again) != len(points) or (again != points).any()  # fresh noise


@pytest.mark.parametrize("name", ROBOTS)
def test_the_waiting_arm_is_out_of_the_cameras_sight(name: str) -> None:
    """No ray from the camera to the bin's rim or floor meets the robot."""
    cell = WorkCell(CellConfig(name), scene((brick(), 0.0, 0.0)))
    model, data = cell.physics.model, cell.physics.data
    eye, hit = LAYOUT.camera.position, np.zeros(1, np.int32)
    corners = LAYOUT.pick_bin.inside.corners()
    targets = [*corners, *(0.5 * (a + b) for a in corners for b in corners)]
    for target in targets:
        direction = target - eye
        mujoco.mj_ray(model, data, eye, direction / np.linalg.norm(direction), None, 1, -1, hit, None)
        owner = model.body(model.geom_bodyid[int(hit[0])]).name
        assert not owner.startswith((PREFIX, "__gripper__")), owner


def test_the_files_numbers_are_those_of_the_layout() -> None:
    """config/bin_picking.yaml tells the nodes where camera and bin are."""
    path = Path(__file__).resolve().parents[2] / "config" / "bin_picking.yaml"
    sections = {key.split("/")[-1]: value["ros__parameters"] for key, value in yaml.safe_load(path.read_text()).items()}
    pose = sections["preprocessor"]["sensor_pose"]
    assert pose_matrix(pose[:3], pose[3:]) == pytest.approx(LAYOUT.camera.T_world_camera, abs=1e-5)
    for key, corner in (("crop_min", LAYOUT.view.lower), ("crop_max", LAYOUT.view.upper)):
        assert sections["preprocessor"][key] == pytest.approx(corner, abs=1e-9)
    inside = LAYOUT.pick_bin.inside
    target = sections["detector"]["target_min"], sections["detector"]["target_max"]
    assert target[0] == pytest.approx(np.add(inside.lower, [0.005, 0.005, 0.006]))
    assert target[1] == pytest.approx(np.add(inside.upper, [-0.005, -0.005, 0.1]))


def test_a_filled_bin_has_what_the_gripper_can_hold_at_rest() -> None:
    filled = fill(LAYOUT, 2, GRIPPER, seed=3)
    assert len(filled.objects) == 2 and filled.fixtures == LAYOUT.fixtures
    inside = LAYOUT.pick_bin.inside
    centres = filled.poses[:, :3, 3]
    assert ((centres[:, :2] > inside.lower[:2]) & (centres[:, :2] < inside.upper[:2])).all()
    for model in filled.objects:
        sides = np.sort(model.mesh.bounding_box_oriented.primitive.extents)
        assert sides[1] <= 0.75 * GRIPPER.width + 1e-6 and sides[2] <= 0.16 + 1e-6
    again = fill(LAYOUT, 2, GRIPPER, seed=3)
    assert (again.poses == filled.poses).all()


def test_too_many_objects_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "_POOL", 8)
    with pytest.raises(InvalidInputError, match="objects must be in"):
        CellConfig(objects=21)
    with pytest.raises(InvalidInputError, match=r"a gripper of 0\.03 m can hold, not 9"):
        fill(LAYOUT, 9, Gripper(width=0.03), 0)


def test_bins_that_overlap_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="overlap"):
        CellLayout(place=(-0.02, -0.1))
    with pytest.raises(InvalidInputError, match="no depth camera 'eye'"):
        CellLayout(sensor="eye")


def test_a_cell_goes_on_where_another_one_was(fresh: WorkCell, tmp_path: Path) -> None:
    path = tmp_path / "cell.npz"
    assert not restore_state(fresh, path)
    moved: Array = fresh.scene.poses.copy()
    moved[0, 1, 3] += 0.03
    fresh.restore(moved)
    save_state(fresh, path)
    fresh.restore(fresh.scene.poses)
    assert restore_state(fresh, path)
    assert fresh.poses() == pytest.approx(moved, abs=1e-9)
    assert [file.name for file in tmp_path.iterdir()] == ["cell.npz"]


def test_the_state_of_another_cell_is_refused(fresh: WorkCell, tmp_path: Path) -> None:
    path = tmp_path / "cell.npz"
    save_state(fresh, path)
    other = WorkCell(replace(fresh.config, seed=9), fresh.scene)
    with pytest.raises(InvalidInputError, match="a cell with other objects"):
        restore_state(other, path)
    path.write_text("nothing")
    with pytest.raises(InvalidInputError, match="holds no state of a cell"):
        restore_state(fresh, path)


def test_the_light_list_of_robots_is_that_of_the_models() -> None:
    assert tuple(ROBOTS) == ROBOT_NAMES
    assert all(get_robot(name).name == name for name in ROBOT_NAMES)
