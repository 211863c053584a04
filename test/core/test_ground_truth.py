"""The judge against cases worked out by hand."""

import numpy as np
import pytest
import trimesh

from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.ground_truth import NO_OBJECT, GroundTruth
from regnet_core.geometry import Box
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper

GRIPPER = Gripper(width=0.08)
DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Columns: approach -z, closing +y, their cross product +x."""
TABLE = Box((-0.5, -0.5, -0.05), (0.5, 0.5, 0.0))


def _about_x(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _grasps(*poses: tuple[np.ndarray, tuple[float, float, float]], width: float = 0.08) -> Grasps:
    m = len(poses)
    rotation = np.array([pose[0] for pose in poses]).reshape(m, 3, 3)
    translation = np.array([pose[1] for pose in poses]).reshape(m, 3)
    return Grasps(rotation, translation, np.full(m, width), np.ones(m), np.ones(m), np.ones(m))


def _box(size: tuple[float, float, float], centre: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents=size)
    mesh.apply_translation(centre)
    return mesh


BRICK = _box((0.05, 0.04, 0.06), (0.0, 0.0, 0.03))
"""Stands on z = 0, 0.04 m wide in y, its top at z = 0.06."""


# Antipodal score


def test_opposite_faces_of_a_box_score_one() -> None:
    truth = GroundTruth([BRICK], TABLE).antipodal(_grasps((DOWN, (0.0, 0.0, 0.08))), GRIPPER)
    np.testing.assert_allclose(truth.score, 1.0, atol=1e-6)
    np.testing.assert_allclose(truth.contact_width, 0.04, atol=1e-6)
    assert truth.object_index.tolist() == [0]


@pytest.mark.parametrize("degrees", [5.0, 15.0, 30.0])
def test_a_box_seen_askew_scores_cosine_squared(degrees: float) -> None:
    angle = np.radians(degrees)
    box = _box((0.2, 0.03, 0.06), (0.0, 0.0, 0.03))  # long, so that both pads meet its long faces
    grasp = _grasps((_about_z(angle) @ DOWN, (0.0, 0.0, 0.08)))
    truth = GroundTruth([box], TABLE).antipodal(grasp, GRIPPER)
    np.testing.assert_allclose(truth.score, np.cos(angle) ** 2, atol=1e-5)
    # Between the parallel faces along y, plus the advance of each pad's outer edge.
    expected = 0.03 / np.cos(angle) + GRIPPER.height * np.tan(angle)
    np.testing.assert_allclose(truth.contact_width, expected, atol=1e-4)


@pytest.mark.parametrize("radius", [0.015, 0.03])
def test_a_lying_cylinder_scores_one_across_its_axis(radius: float) -> None:
    cylinder = trimesh.creation.cylinder(radius=radius, height=0.15, sections=720)
    cylinder.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0.0, 1.0, 0.0]))
    cylinder.apply_translation([0.0, 0.0, radius])
    truth = GroundTruth([cylinder], TABLE).antipodal(_grasps((DOWN, (0.0, 0.0, radius + 0.03))), GRIPPER)
    np.testing.assert_allclose(truth.score, 1.0, atol=0.005)
    np.testing.assert_allclose(truth.contact_width, 2.0 * radius, atol=5e-5)


@pytest.mark.parametrize("above", [0.005, 0.01, 0.02])
def test_fingertips_above_a_cylinders_middle_score_the_closed_form(above: float) -> None:
    radius = 0.03
    cylinder = trimesh.creation.cylinder(radius=radius, height=0.15, sections=1440)
    cylinder.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0.0, 1.0, 0.0]))
    # The tips reach `above` over the axis: the first contact is there, where the normal leans up by asin(above / r).
    truth = GroundTruth([cylinder], None).antipodal(_grasps((DOWN, (0.0, 0.0, above + GRIPPER.depth))), GRIPPER)
    # Averaging near ties reaches 0.5 mm deeper, so a little steeper than at the tip itself.
    np.testing.assert_allclose(truth.score, 1.0 - (above / radius) ** 2, atol=0.02)
    assert truth.score[0] <= 1.0 - (above / radius) ** 2 + 0.002
    np.testing.assert_allclose(truth.contact_width, 2.0 * np.sqrt(radius**2 - above**2), atol=5e-5)


def test_a_sphere_scores_one_through_its_centre() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.025)
    turned = [_about_z(angle) @ DOWN for angle in np.linspace(0.0, np.pi, 7)]
    poses = [(rotation, (0.0, 0.0, 0.03)) for rotation in turned]
    truth = GroundTruth([sphere], None).antipodal(_grasps(*poses), GRIPPER)
    np.testing.assert_allclose(truth.score, 1.0, atol=0.005)
    np.testing.assert_allclose(truth.contact_width, 0.05, atol=1e-4)


def test_a_wedge_scores_the_product_of_both_cosines() -> None:
    """A prism with one face across the closing direction and one leaning by 20 degrees."""
    angle = np.radians(20.0)
    lean = 0.06 * np.tan(angle)
    corners = [(y, z) for y, z in ((-0.02, 0.0), (0.02, 0.0), (0.02 - lean, 0.06), (-0.02, 0.06))]
    prism = trimesh.convex.convex_hull(np.array([(x, y, z) for x in (-0.05, 0.05) for y, z in corners]))
    truth = GroundTruth([prism], None).antipodal(_grasps((DOWN, (0.0, 0.0, 0.08))), GRIPPER)
    np.testing.assert_allclose(truth.score, np.cos(angle), atol=1e-5)
    # The leaning face is met at the height of the tips, z = 0.02.
    np.testing.assert_allclose(truth.contact_width, 0.04 - 0.02 * np.tan(angle), atol=2e-5)


def test_swapping_the_fingers_changes_nothing() -> None:
    swap = np.diag([1.0, -1.0, -1.0])
    poses = [(rotation @ DOWN, (0.0, 0.004, 0.075)) for rotation in (_about_z(0.2), _about_x(0.1))]
    mirrored = [(rotation @ swap, centre) for rotation, centre in poses]
    judge = GroundTruth([BRICK], TABLE)
    first, second = (judge.antipodal(_grasps(*group), GRIPPER) for group in (poses, mirrored))
    np.testing.assert_allclose(first.score, second.score, atol=1e-6)
    np.testing.assert_allclose(first.contact_width, second.contact_width, atol=1e-6)
    assert np.all(first.score > 0.5)


def test_nothing_between_the_fingers_scores_zero() -> None:
    truth = GroundTruth([BRICK], TABLE).antipodal(_grasps((DOWN, (0.2, 0.0, 0.08))), GRIPPER)
    assert truth.score[0] == 0.0 and np.isnan(truth.contact_width[0]) and truth.object_index[0] == NO_OBJECT


def test_contacts_on_two_objects_score_zero() -> None:
    pair = [_box((0.05, 0.015, 0.06), (0.0, y, 0.03)) for y in (-0.01, 0.01)]
    truth = GroundTruth(pair, TABLE).antipodal(_grasps((DOWN, (0.0, 0.0, 0.08))), GRIPPER)
    assert truth.score[0] == 0.0 and truth.object_index[0] == NO_OBJECT
    np.testing.assert_allclose(truth.contact_width, 0.035, atol=1e-6)


def test_a_pad_that_meets_the_table_scores_zero() -> None:
    # From the side, closing upwards: the lower finger comes from under the table and touches it before the brick.
    side = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T
    assert np.allclose(side[:, 0], [1, 0, 0]) and np.allclose(side[:, 1], [0, 0, 1])
    low = _box((0.05, 0.04, 0.02), (0.0, 0.0, 0.01))
    truth = GroundTruth([low], TABLE).antipodal(_grasps((side, (-0.05, 0.0, -0.03)), width=0.08), GRIPPER)
    assert truth.score[0] == 0.0 and truth.object_index[0] == NO_OBJECT


def test_fingers_inside_an_object_score_zero() -> None:
    wide = _box((0.05, 0.07, 0.06), (0.0, 0.0, 0.03))
    truth = GroundTruth([wide], TABLE).antipodal(_grasps((DOWN, (0.0, 0.03, 0.08)), width=0.05), GRIPPER)
    assert truth.score[0] == 0.0


def test_many_grasps_are_judged_like_each_alone() -> None:
    rng = np.random.default_rng(0)
    poses = [(_about_z(a) @ _about_x(b) @ DOWN, (0.0, y, 0.08)) for a, b, y in rng.uniform(-0.3, 0.3, (40, 3)) * 0.1]
    judge = GroundTruth([BRICK], TABLE)
    together = judge.antipodal(_grasps(*poses), GRIPPER)
    alone = np.array([judge.antipodal(_grasps(pose), GRIPPER).score[0] for pose in poses])
    np.testing.assert_array_equal(together.score, alone)
    assert len(np.unique(alone)) > 10


# Width of what is held


def test_enclosed_width_is_not_cut_off_at_the_pads() -> None:
    wide = _box((0.05, 0.07, 0.06), (0.0, 0.0, 0.03))
    narrow = _grasps((DOWN, (0.0, 0.0, 0.08)), (DOWN, (0.0, 0.03, 0.08)), (DOWN, (0.2, 0.0, 0.08)), width=0.04)
    width = GroundTruth([wide], TABLE).enclosed_width(narrow, GRIPPER)
    np.testing.assert_allclose(width[:2], 0.07, atol=1e-5)
    assert np.isnan(width[2])


def test_enclosed_width_is_that_of_the_wall_a_cup_is_held_by() -> None:
    outer = trimesh.creation.annulus(r_min=0.036, r_max=0.04, height=0.08, sections=360)
    grasp = _grasps((DOWN, (0.0, 0.038, 0.07)), width=0.04)
    judge = GroundTruth([outer], None)
    arc = 0.04 - np.sqrt(0.036**2 - 0.005**2)  # the inner wall curves away over the pad's height
    np.testing.assert_allclose(judge.enclosed_width(grasp, GRIPPER), arc, atol=1e-4)
    np.testing.assert_allclose(judge.antipodal(grasp, GRIPPER).contact_width, arc, atol=1e-4)


def test_enclosed_width_is_that_of_the_object_that_fills_most() -> None:
    pair = [_box((0.05, 0.03, 0.06), (0.0, 0.0, 0.03)), _box((0.05, 0.1, 0.06), (0.0, 0.085, 0.03))]
    width = GroundTruth(pair, TABLE).enclosed_width(_grasps((DOWN, (0.0, 0.0, 0.08))), GRIPPER)
    np.testing.assert_allclose(width, 0.03, atol=1e-5)


# Collision


@pytest.mark.parametrize(
    ("centre", "width", "expected"),
    [
        ((0.0, 0.0, 0.0701), 0.08, False),  # fingertips 10.1 mm above the table, palm 10.1 mm above the brick
        ((0.0, 0.0, 0.0602), 0.08, False),  # 0.2 mm above both
        ((0.0, 0.0, 0.0598), 0.08, True),  # tips in the table and palm in the brick
        ((0.0, 0.0199, 0.08), 0.08, False),  # the right finger passes the brick by 0.1 mm
        ((0.0, 0.0201, 0.08), 0.08, True),
        ((0.0, 0.0, 0.08), 0.0402, False),  # opened by 0.1 mm more than the brick on each side
        ((0.0, 0.0, 0.08), 0.0398, True),
        ((0.0299, 0.0201, 0.08), 0.08, True),  # the hand is 10 mm thick in x and still overlaps by 0.1 mm
        ((0.0301, 0.0201, 0.08), 0.08, False),
        ((0.2, 0.0, 0.061), 0.08, False),  # beside the brick
    ],
)
def test_collision_with_a_brick_on_a_table(centre: tuple, width: float, expected: bool) -> None:
    grasp = _grasps((DOWN, centre), width=width)
    assert GroundTruth([BRICK], TABLE).collides(grasp, GRIPPER).tolist() == [expected]


def test_only_the_table_collides_when_the_tips_are_below_it() -> None:
    grasps = _grasps((DOWN, (0.2, 0.0, 0.0599)), (DOWN, (0.2, 0.0, 0.0601)))
    assert GroundTruth([BRICK], TABLE).collides(grasps, GRIPPER).tolist() == [True, False]
    assert GroundTruth([BRICK], None).collides(grasps, GRIPPER).tolist() == [False, False]


def test_the_palm_is_as_wide_as_the_open_hand() -> None:
    post = _box((0.01, 0.004, 0.2), (0.0, 0.045, 0.1))  # beside the closed fingers, under the palm's end
    grasp = _grasps((DOWN, (0.0, 0.0, 0.15)), width=0.02)
    judge = GroundTruth([post], None)
    assert judge.collides(grasp, GRIPPER).tolist() == [True]
    assert judge.collides(grasp, GRIPPER.replace(width=0.05)).tolist() == [False]


def test_a_finger_wholly_inside_an_object_collides() -> None:
    block = _box((0.3, 0.3, 0.3), (0.0, 0.0, 0.0))
    assert GroundTruth([block], None).collides(_grasps((DOWN, (0.0, 0.0, 0.0))), GRIPPER).tolist() == [True]


def test_collision_agrees_with_points_inside_the_boxes() -> None:
    """Brute force: a dense set of points in the hand's boxes against each solid's own inside test."""
    rng = np.random.default_rng(7)
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    sphere.apply_translation([0.05, 0.0, 0.03])
    meshes = [BRICK, sphere]
    angles = rng.uniform(-np.pi, np.pi, (60, 2))
    poses = [
        (_about_z(a) @ _about_x(0.3 * b) @ DOWN, tuple(rng.uniform([-0.1, -0.1, 0.065], [0.1, 0.1, 0.12])))
        for a, b in angles
    ]
    grasps = _grasps(*poses)
    unit = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 14)] * 3), axis=-1).reshape(-1, 3)
    expected = []
    for rotation, centre in poses:
        boxes = [np.array(b.lower) + unit * np.subtract(b.upper, b.lower) for b in GRIPPER.bodies(opening=0.08)]
        points = np.concatenate(boxes) @ rotation.T + centre
        inside_brick = np.all(np.abs(points - [0.0, 0.0, 0.03]) < [0.025, 0.02, 0.03], axis=1)
        inside_sphere = np.linalg.norm(points - [0.05, 0.0, 0.03], axis=1) < 0.03 * 0.99
        expected.append(bool(inside_brick.any() or inside_sphere.any() or (points[:, 2] < 0.0).any()))
    found = GroundTruth(meshes, TABLE).collides(grasps, GRIPPER)
    assert 10 < sum(expected) < 50
    # Points can miss an overlap that is thinner than their spacing, never invent one.
    assert np.all(found[np.array(expected)])
    assert np.mean(found == np.array(expected)) > 0.95


# Limits


def test_no_grasps_and_no_objects() -> None:
    none = Grasps.empty()
    judge = GroundTruth([BRICK], TABLE)
    assert judge.collides(none, GRIPPER).shape == (0,) and judge.antipodal(none, GRIPPER).score.shape == (0,)
    assert judge.enclosed_width(none, GRIPPER).shape == (0,)
    bare = GroundTruth([], None)
    grasp = _grasps((DOWN, (0.0, 0.0, 0.08)))
    assert bare.collides(grasp, GRIPPER).tolist() == [False] and bare.antipodal(grasp, GRIPPER).score.tolist() == [0.0]


def test_a_mesh_with_a_hole_is_refused() -> None:
    leaky = trimesh.Trimesh(BRICK.vertices, BRICK.faces[1:], process=False)
    with pytest.raises(InvalidInputError, match=r"watertight meshes; those with index \[1\] are not"):
        GroundTruth([BRICK, leaky], TABLE)
