"""The procedural objects: closed solids of known size, drawn from a seed."""

import numpy as np
import open3d as o3d
import pytest
import trimesh
from numpy.typing import NDArray

from regnet_core.data.objects.meshing import SECTIONS, Solid, union
from regnet_core.data.objects.models import FAMILIES, Family, ObjectModel, build_mesh, build_solid, sample_object
from regnet_core.data.objects.user_meshes import WIDEST_GRASP, grasp_width
from regnet_core.errors import InvalidInputError


def _model(family: str, params: dict[str, float], density: float = 1000.0) -> ObjectModel:
    return ObjectModel("thing", family, params, build_mesh(family, params), (200, 10, 10), density, 0.5)


def _params(family: str, share: float | NDArray[np.float64]) -> dict[str, float]:
    ranges = FAMILIES[family].ranges
    shares = np.broadcast_to(share, len(ranges))
    return {key: low + (high - low) * float(u) for (key, (low, high)), u in zip(ranges.items(), shares, strict=True)}


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_gives_closed_graspable_solids(family: str) -> None:
    rng = np.random.default_rng(3)
    for _ in range(8):
        model = sample_object(rng, family)
        assert model.mesh.is_volume, model.params
        assert model.mesh.body_count == 1, model.params
        assert 0.02 <= model.mesh.extents.max() < 0.26, model.params
        assert grasp_width(model.mesh) < WIDEST_GRASP, model.params
        np.testing.assert_allclose(model.mesh.center_mass, 0.0, atol=1e-9)
        assert 0.002 < model.mass < 2.6, model.params


@pytest.mark.parametrize("family", FAMILIES)
def test_the_corners_of_a_family_are_closed_solids_of_sound_parts(family: str) -> None:
    rng = np.random.default_rng(4)
    corners = [np.zeros(1), np.ones(1), *rng.integers(2, size=(6, len(FAMILIES[family].ranges)))]
    for shares in corners:
        solid = build_solid(family, _params(family, shares))
        assert solid.mesh.is_volume and solid.mesh.body_count == 1, shares
        # MuJoCo refuses parts of no volume.
        assert all(part.is_volume and part.volume > 1e-9 for part in solid.parts), shares


def test_the_same_seed_gives_the_same_object() -> None:
    first, again, other = (sample_object(np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert first.family == again.family and first.params == again.params and first.colour == again.colour
    np.testing.assert_array_equal(first.mesh.vertices, again.mesh.vertices)
    assert (first.density, first.friction) != (other.density, other.friction)


def test_volumes_agree_with_closed_forms() -> None:
    box = build_mesh("box", {"x": 0.03, "y": 0.05, "z": 0.1})
    assert box.volume == pytest.approx(0.03 * 0.05 * 0.1)
    cylinder = build_mesh("cylinder", {"radius": 0.02, "height": 0.1})
    polygon = 0.5 * SECTIONS * 0.02**2 * np.sin(2.0 * np.pi / SECTIONS)
    assert cylinder.volume == pytest.approx(polygon * 0.1)
    ring = build_mesh("ring", {"radius": 0.04, "tube": 0.01})
    assert ring.volume == pytest.approx(2.0 * np.pi**2 * 0.04 * 0.01**2, rel=0.03)
    ellipsoid = build_mesh("superquadric", {"x": 0.02, "y": 0.03, "z": 0.05, "e1": 1.0, "e2": 1.0})
    assert ellipsoid.volume == pytest.approx(4.0 / 3.0 * np.pi * 0.02 * 0.03 * 0.05, rel=0.02)
    bracket = build_mesh("l_profile", {"long_leg": 0.1, "short_leg": 0.06, "thickness": 0.02, "width": 0.03})
    assert bracket.volume == pytest.approx(0.03 * (0.1 * 0.02 + 0.06 * 0.02 - 0.02 * 0.02))


def test_a_cup_is_hollow_and_its_handle_leaves_a_hole() -> None:
    cup = build_mesh("cup", {"radius": 0.04, "height": 0.1, "taper": 1.0, "wall": 0.004, "handle": 0.005})
    assert cup.volume < 0.35 * np.pi * 0.04**2 * 0.1
    assert cup.euler_number == 0  # a torus: one hole, between the wall and the handle


def test_mass_and_inertia_of_a_box() -> None:
    box = _model("box", {"x": 0.03, "y": 0.05, "z": 0.1}, density=800.0)
    assert box.mass == pytest.approx(800.0 * 0.03 * 0.05 * 0.1)
    squares = np.array([0.05**2 + 0.1**2, 0.03**2 + 0.1**2, 0.03**2 + 0.05**2])
    np.testing.assert_allclose(box.inertia, np.diag(box.mass / 12.0 * squares), rtol=1e-9, atol=1e-15)


def test_convex_parts_are_convex_and_fill_the_object() -> None:
    bracket = _model("l_profile", {"long_leg": 0.1, "short_leg": 0.06, "thickness": 0.02, "width": 0.03})
    parts = bracket.convex_parts
    assert all(part.is_convex for part in parts)
    assert sum(part.volume for part in parts) == pytest.approx(bracket.mesh.volume, rel=0.05)
    assert bracket.convex_parts is parts  # decomposed once


@pytest.mark.parametrize("family", FAMILIES)
def test_parts_by_construction_fill_the_object_and_nothing_else(family: str) -> None:
    # A bowl is curved both ways, and finer parts would be too many.
    reach, share, most = (0.0015, 0.06, 55) if family == "bowl" else (0.001, 0.04, 40)
    rng = np.random.default_rng(5)
    for shares in (1.0, rng.uniform(size=len(FAMILIES[family].ranges))):
        solid = build_solid(family, _params(family, shares))
        filled = trimesh.boolean.union(list(solid.parts), engine="manifold")
        assert filled.volume == pytest.approx(solid.mesh.volume, rel=share)
        assert _signed_distance(solid.mesh, filled).max() < reach, "parts stick out"
        assert _signed_distance(filled, solid.mesh).max() < reach, "parts leave something out"
        assert len(solid.parts) <= most


def _signed_distance(mesh: trimesh.Trimesh, other: trimesh.Trimesh) -> NDArray[np.float32]:
    """Of points on the other's surface to the mesh, positive outside [m]."""
    points = np.concatenate([trimesh.sample.sample_surface(other, 2000, seed=0)[0], other.vertices])
    return _rays(mesh).compute_signed_distance(o3d.core.Tensor(points.astype(np.float32)), nsamples=3).numpy()


def _rays(mesh: trimesh.Trimesh) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    vertices = o3d.core.Tensor(np.asarray(mesh.vertices, dtype=np.float32))
    scene.add_triangles(vertices, o3d.core.Tensor(np.asarray(mesh.faces, dtype=np.uint32)))
    return scene


@pytest.mark.parametrize("family", ["cup", "bowl", "plate", "pan", "goblet", "pipe", "ring", "nut", "drilled", "tray"])
def test_fingers_enter_what_is_hollow(family: str) -> None:
    solid = build_solid(family, _params(family, 0.5))
    middle = 0.5 * (solid.mesh.bounds[0] + solid.mesh.bounds[1])
    x, y = (0.0, 0.0) if family in ("cup", "pan") else middle[:2]
    # A finger of 4 mm comes down from above, ending a little below the rim.
    finger = trimesh.creation.box(extents=(0.004, 0.004, 0.02))
    finger.apply_translation([x, y, solid.mesh.bounds[1][2] + 0.01 - 0.15 * np.ptp(solid.mesh.bounds[:, 2])])
    for part in solid.parts:
        assert trimesh.boolean.intersection([part, finger], engine="manifold").is_empty


def test_the_wall_of_a_bowl_is_as_thick_in_physics_as_it_is() -> None:
    bowl = build_solid("bowl", {"radius": 0.07, "depth": 0.6, "wall": 0.004})
    filled = trimesh.boolean.union(list(bowl.parts), engine="manifold")
    true, physical = (_wall_along_radii(mesh) for mesh in (bowl.mesh, filled))
    assert np.mean(physical) == pytest.approx(np.mean(true), abs=0.0005)


def _wall_along_radii(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """How far horizontal rays from outside go through a bowl's wall [m]."""
    heights = mesh.bounds[0][2] + np.linspace(0.006, 0.04, 20)
    angle, z = (grid.ravel() for grid in np.meshgrid(np.linspace(0.01, 6.2, 61), heights))
    inwards = -np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    starts = -0.1 * inwards + z[:, None] * (0.0, 0.0, 1.0)
    hits = _rays(mesh).list_intersections(o3d.core.Tensor(np.concatenate([starts, inwards], axis=1).astype(np.float32)))
    distance, ray = hits["t_hit"].numpy(), hits["ray_ids"].numpy()
    crossings = (np.sort(distance[ray == k]) for k in range(len(angle)))
    return np.array([distances[1] - distances[0] for distances in crossings], dtype=np.float64)


def test_a_union_keeps_the_parts_of_its_members() -> None:
    first, second = build_solid("block", _params("block", 0.5)), build_solid("cylinder", _params("cylinder", 0.5))
    both = union([first, second.moved(x=0.01)])
    assert isinstance(both, Solid) and len(both.parts) == 2
    assert both.mesh.volume < first.mesh.volume + second.mesh.volume


def test_an_object_is_drawn_from_the_ranges_that_are_given_and_none_that_is_held_out() -> None:
    narrow = {
        "block": Family(FAMILIES["block"].build, {"width": (0.05, 0.05), "depth": (1.0, 1.0), "height": (1.0, 1.0)}),
        "star": FAMILIES["star"],
    }
    for seed in range(8):
        model = sample_object(np.random.default_rng(seed), families=narrow)
        assert model.family == "block" and model.params == {"width": 0.05, "depth": 1.0, "height": 1.0}
    assert sample_object(np.random.default_rng(0), "star", families=narrow).family == "star"


def test_a_convex_family_is_its_own_only_part() -> None:
    can = _model("can", {"radius": 0.03, "height": 0.1, "chamfer": 0.004})
    (part,) = can.convex_parts
    assert part.volume == pytest.approx(can.mesh.volume)


def test_an_unknown_family_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InvalidInputError, match="no object family 'teapot'; there are box, block, cylinder"):
        sample_object(np.random.default_rng(0), "teapot")


def test_wrong_parameters_are_refused_with_the_right_ones() -> None:
    with pytest.raises(InvalidInputError, match=r"cylinder takes the parameters \['height', 'radius'\]"):
        build_mesh("cylinder", {"radius": 0.02})
