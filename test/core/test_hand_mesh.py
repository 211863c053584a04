"""An open hand against a mesh: exact against python-fcl, and known contacts on a box, a cylinder and a ball."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from regnet_core.data.objects.models import sample_object
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.geometry import Box
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.ops.hand_mesh import HandMesh, box_mesh_faces, hand_on_mesh
from regnet_core.ops.triangle_tree import TriangleTree, build_tree

HAND = Gripper(width=0.08)
DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Approach straight down, closing along y."""


def _meet(mesh: trimesh.Trimesh, rotation: np.ndarray, translation: np.ndarray, gripper: Gripper = HAND) -> HandMesh:
    rotation, translation = np.atleast_3d(rotation).reshape(-1, 3, 3), np.atleast_2d(translation)
    opening = np.full(len(rotation), gripper.width)
    return hand_on_mesh(build_tree(mesh.vertices, mesh.faces), rotation, translation, opening, gripper)


def _about_approach(angle: float) -> np.ndarray:
    """The downward hand, rolled by the angle [rad]."""
    return Rotation.from_euler("z", angle).as_matrix() @ DOWN


@pytest.mark.parametrize("family", ["box", "cylinder", "cup", "bowl", "ring", "hammer"])
def test_collisions_are_those_of_fcl(family: str) -> None:
    rng = np.random.default_rng(1)
    mesh = sample_object(rng, family).mesh
    rotation = Rotation.random(400, rng=rng).as_matrix()
    translation = mesh.sample(400, seed=2) - rotation[:, :, 0] * rng.uniform(0.0, 0.08, (400, 1))
    met = _meet(mesh, rotation, translation)
    nothing = np.zeros(400)
    grasps = Grasps(rotation, translation, np.full(400, HAND.width), nothing, nothing, nothing)
    truth = GroundTruth([mesh], None).collides(grasps, HAND)
    assert 0.2 < truth.mean() < 0.99
    np.testing.assert_array_equal(met.collides, truth)


def test_contacts_are_those_of_rays_on_a_smooth_object() -> None:
    rng = np.random.default_rng(3)
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    rotation = Rotation.random(300, rng=rng).as_matrix()
    translation = rng.uniform(-0.008, 0.008, (300, 3)) - 0.05 * rotation[:, :, 0]
    met = _meet(mesh, rotation, translation)
    free = ~met.collides
    nothing = np.zeros(300)
    grasps = Grasps(rotation, translation, np.full(300, HAND.width), nothing, nothing, nothing)
    truth = GroundTruth([mesh], None).antipodal(grasps, HAND)
    assert free.sum() > 100
    np.testing.assert_allclose((met.high - met.low)[free], truth.contact_width[free], atol=0.0005)
    np.testing.assert_allclose((met.cos_high * met.cos_low)[free], truth.score[free], atol=0.03)


@pytest.mark.parametrize("degrees", [0.0, 10.0, 25.0, 40.0])
def test_score_on_a_box_is_the_squared_cosine_of_the_roll(degrees: float) -> None:
    box = trimesh.creation.box((0.2, 0.04, 0.05))
    met = _meet(box, _about_approach(np.radians(degrees)), [0.0, 0.0, 0.06])
    assert not met.collides[0]
    assert met.cos_high[0] * met.cos_low[0] == pytest.approx(np.cos(np.radians(degrees)) ** 2, abs=0.02)


@pytest.mark.parametrize("offset", [0.0, 0.01, 0.02])
def test_score_on_a_cylinder_is_that_of_the_offset(offset: float) -> None:
    cylinder = trimesh.creation.cylinder(radius=0.03, height=0.1, sections=360)
    met = _meet(cylinder, DOWN, [offset, 0.0, 0.09])
    nearest = max(offset - HAND.height / 2, 0.0)
    assert met.cos_high[0] * met.cos_low[0] == pytest.approx(1.0 - (nearest / 0.03) ** 2, abs=0.02)
    assert met.high[0] - met.low[0] == pytest.approx(2.0 * np.sqrt(0.03**2 - nearest**2), abs=1e-4)


@pytest.mark.parametrize("offset", [0.0, 0.01, 0.02])
def test_score_on_a_ball_is_that_of_the_offset(offset: float) -> None:
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.03)
    met = _meet(ball, DOWN, [offset, 0.0, 0.05])
    nearest = max(offset - HAND.height / 2, 0.0)
    assert met.cos_high[0] * met.cos_low[0] == pytest.approx(1.0 - (nearest / 0.03) ** 2, abs=0.02)


def test_a_tip_that_reaches_half_way_to_a_ball_touches_below_its_equator() -> None:
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.03)
    met = _meet(ball, DOWN, [0.0, 0.0, 0.06 + 0.015])  # fingertips at z = 0.015
    assert met.cos_high[0] == pytest.approx(np.cos(np.arcsin(0.015 / 0.03)), abs=0.02)
    assert met.nearest[0] == pytest.approx(0.045, abs=1e-4) and met.on_axis[0] == pytest.approx(0.045, abs=1e-4)


def test_an_empty_jaw_has_no_contacts() -> None:
    met = _meet(trimesh.creation.box((0.02, 0.02, 0.02)), DOWN, [0.5, 0.0, 0.0])
    assert not met.collides[0] and met.high[0] == -np.inf and met.low[0] == np.inf
    assert met.cos_high[0] == met.cos_low[0] == 0.0 and met.on_axis[0] == met.nearest[0] == np.inf


def test_the_clearance_grows_fingers_and_palm() -> None:
    box = trimesh.creation.box((0.05, 0.078, 0.05))  # 1 mm to spare on each side
    tree, args = build_tree(box.vertices, box.faces), (DOWN[None], np.array([[0.0, 0.0, 0.06]]), np.array([0.08]), HAND)
    assert not hand_on_mesh(tree, *args).collides[0]
    assert not hand_on_mesh(tree, *args, 0.0009).collides[0]
    assert hand_on_mesh(tree, *args, 0.0011).collides[0]
    above = np.array([[0.0, 0.0, 0.026]])  # palm 1 mm above the top
    thin = trimesh.creation.box((0.05, 0.02, 0.05))
    tree = build_tree(thin.vertices, thin.faces)
    assert not hand_on_mesh(tree, DOWN[None], above, np.array([0.08]), HAND, 0.0009).collides[0]
    assert hand_on_mesh(tree, DOWN[None], above, np.array([0.08]), HAND, 0.0011).collides[0]


def test_without_bodies_everything_between_the_pads_is_seen() -> None:
    wide = trimesh.creation.box((0.05, 0.2, 0.05))
    tree, args = (
        build_tree(wide.vertices, wide.faces),
        (DOWN[None], np.array([[0.0, 0.0, 0.06]]), np.array([0.08]), HAND),
    )
    assert hand_on_mesh(tree, *args).collides[0]
    met = hand_on_mesh(tree, *args, bodies=False)
    assert not met.collides[0]
    assert (met.low[0], met.high[0]) == pytest.approx((-0.04, 0.04))


def test_the_tree_holds_every_triangle_inside_its_node() -> None:
    mesh = trimesh.creation.torus(0.04, 0.01)
    tree = build_tree(mesh.vertices, mesh.faces)
    assert sorted(map(tuple, tree.corners.reshape(-1, 9).round(9))) == sorted(
        map(tuple, mesh.triangles.reshape(-1, 9).round(9))
    )
    seen = _check_node(tree, 0)
    assert sorted(seen) == list(range(len(mesh.faces)))


def _check_node(tree: TriangleTree, node: int) -> list[int]:
    if tree.leaf_count[node]:
        rows = list(range(tree.first[node], tree.first[node] + tree.leaf_count[node]))
    else:
        rows = _check_node(tree, node + 1) + _check_node(tree, int(tree.right[node]))
    corners = tree.corners[rows].reshape(-1, 3)
    np.testing.assert_allclose(corners.min(axis=0), tree.lower[node])
    np.testing.assert_allclose(corners.max(axis=0), tree.upper[node])
    return rows


def test_the_faces_of_a_box_point_outwards() -> None:
    corners = Box((-1.0, -2.0, -3.0), (1.0, 2.0, 3.0)).corners()
    mesh = trimesh.Trimesh(corners, box_mesh_faces(), process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(48.0)
