"""The procedural objects: closed solids of known size, drawn from a seed."""

import numpy as np
import pytest

from regnet_core.data.meshing import SECTIONS
from regnet_core.data.objects import FAMILIES, ObjectModel, build_mesh, sample_object
from regnet_core.errors import InvalidInputError


def _model(family: str, params: dict[str, float], density: float = 1000.0) -> ObjectModel:
    return ObjectModel("thing", family, params, build_mesh(family, params), (200, 10, 10), density, 0.5)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_gives_closed_graspable_solids(family: str) -> None:
    rng = np.random.default_rng(3)
    for _ in range(8):
        model = sample_object(rng, family)
        extents = model.mesh.extents
        assert model.mesh.is_volume, model.params
        assert model.mesh.body_count == 1, model.params
        assert 0.015 < extents.max() < 0.27, model.params
        # What is too wide for a hand as a whole has a wall to hold it by.
        assert extents.min() < 0.07 or "wall" in model.params, model.params
        np.testing.assert_allclose(model.mesh.center_mass, 0.0, atol=1e-9)
        assert 0.003 < model.mass < 2.0, model.params


@pytest.mark.parametrize("family", FAMILIES)
def test_the_extreme_parameters_of_a_family_are_closed_solids(family: str) -> None:
    for end in (0, 1):
        mesh = build_mesh(family, {key: bounds[end] for key, bounds in FAMILIES[family].ranges.items()})
        assert mesh.is_volume and mesh.body_count == 1


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


def test_a_convex_family_is_its_own_only_part() -> None:
    can = _model("can", {"radius": 0.03, "height": 0.1, "chamfer": 0.004})
    (part,) = can.convex_parts
    assert part.volume == pytest.approx(can.mesh.volume)


def test_an_unknown_family_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InvalidInputError, match="no object family 'teapot'; there are box, cylinder"):
        sample_object(np.random.default_rng(0), "teapot")


def test_wrong_parameters_are_refused_with_the_right_ones() -> None:
    with pytest.raises(InvalidInputError, match=r"cylinder takes the parameters \['height', 'radius'\]"):
        build_mesh("cylinder", {"radius": 0.02})
