"""Importing a user's meshes: what is repaired, what is refused and why, and how objects are named."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from regnet_core.data.objects.files import object_from_bytes, object_to_bytes
from regnet_core.data.objects.models import build_mesh
from regnet_core.data.objects.user_meshes import (
    FAMILY,
    GREY,
    HEAVIEST,
    SUFFIXES,
    ImportResult,
    grasp_width,
    import_meshes,
)
from regnet_core.errors import InvalidInputError

BRACKET = {"long_leg": 0.1, "short_leg": 0.06, "thickness": 0.02, "width": 0.03}


def _bracket() -> trimesh.Trimesh:
    return build_mesh("l_profile", BRACKET)


def _box(x: float = 0.03, y: float = 0.05, z: float = 0.1) -> trimesh.Trimesh:
    return trimesh.creation.box(extents=(x, y, z))


def _write(folder: Path, name: str, mesh: trimesh.Trimesh) -> None:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)


def _only_reason(result: ImportResult) -> str:
    assert result.accepted == ()
    (refusal,) = result.refused
    return refusal.reason


def test_every_format_gives_the_same_object(tmp_path: Path) -> None:
    bracket = _bracket()
    bracket.apply_translation([0.3, -0.2, 0.1])
    for suffix in (".glb", ".gltf", ".obj", ".off", ".ply", ".stl"):
        folder = tmp_path / suffix[1:]
        _write(folder, f"bracket_{suffix[1:]}{suffix}", bracket)
        result = import_meshes(folder)
        assert result.refused == (), suffix
        (model,) = result.accepted
        assert model.mesh.is_volume and model.family == FAMILY and model.name == f"bracket_{suffix[1:]}"
        assert model.mesh.volume == pytest.approx(bracket.volume, rel=1e-4)
        np.testing.assert_allclose(model.mesh.center_mass, 0.0, atol=1e-9)
        assert model.parts is not None and len(model.parts) > 1
        assert sum(part.volume for part in model.parts) == pytest.approx(bracket.volume, rel=0.05)
        assert object_to_bytes(object_from_bytes(object_to_bytes(model))) == object_to_bytes(model)


def test_millimetres_are_refused_with_the_scale_that_cures_it(tmp_path: Path) -> None:
    _write(tmp_path, "box.stl", _box(30.0, 50.0, 170.0))
    reason = _only_reason(import_meshes(tmp_path))
    assert "largest extent is 170 m" in reason
    assert reason.endswith("for a file in millimetres use --objects-scale 0.001")
    (model,) = import_meshes(tmp_path, scale=0.001).accepted
    np.testing.assert_allclose(sorted(model.mesh.extents), [0.03, 0.05, 0.17], rtol=1e-6)


def test_a_mesh_that_is_too_small_is_refused_with_a_scale(tmp_path: Path) -> None:
    _write(tmp_path, "box.stl", _box(30.0, 50.0, 100.0))
    assert "use --objects-scale 0.001" in _only_reason(import_meshes(tmp_path, scale=1e-6))


def test_seams_windings_duplicates_and_small_holes_are_repaired(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    faces = ball.faces[3:]  # a hole
    rng = np.random.default_rng(0)
    faces = np.where(rng.uniform(size=(len(faces), 1)) < 0.5, faces, faces[:, ::-1])  # mixed windings
    faces = np.concatenate([faces, faces[:5], [[7, 7, 9]]])  # duplicate and degenerate faces
    loose = trimesh.Trimesh(ball.vertices[faces.ravel()], np.arange(faces.size).reshape(-1, 3), process=False)  # seams
    _write(tmp_path, "ball.ply", loose)
    (model,) = import_meshes(tmp_path).accepted
    assert model.mesh.is_volume
    assert model.mesh.volume == pytest.approx(ball.volume, rel=0.01)


def test_overlapping_bodies_become_one(tmp_path: Path) -> None:
    post = _box(0.02, 0.02, 0.08)
    post.apply_translation([0.0, 0.0, 0.04])
    _write(tmp_path, "lamp.obj", trimesh.util.concatenate([_box(0.06, 0.06, 0.02), post]))
    (model,) = import_meshes(tmp_path).accepted
    assert model.mesh.is_volume and model.mesh.body_count == 1
    assert model.mesh.volume == pytest.approx(0.06 * 0.06 * 0.02 + 0.02 * 0.02 * 0.07, rel=1e-6)


def test_pieces_that_do_not_touch_are_refused(tmp_path: Path) -> None:
    other = _box()
    other.apply_translation([0.1, 0.0, 0.0])
    _write(tmp_path, "pair.ply", trimesh.util.concatenate([_box(), other]))
    assert "2 pieces that do not touch" in _only_reason(import_meshes(tmp_path))


def test_an_open_shell_is_refused_with_the_size_of_its_hole(tmp_path: Path) -> None:
    box = _box(0.05, 0.05, 0.05)
    _write(tmp_path, "open.ply", trimesh.Trimesh(box.vertices, box.faces[np.abs(box.face_normals[:, 2] - 1.0) > 0.1]))
    assert "a hole of 25.0 cm^2 is 20% of its surface" in _only_reason(import_meshes(tmp_path))


def test_edges_of_more_than_two_faces_are_rebuilt_or_refused(tmp_path: Path) -> None:
    box = _box()
    flap = np.concatenate([box.vertices, [[0.0, 0.2, 0.0]]])
    _write(tmp_path, "flap.ply", trimesh.Trimesh(flap, np.concatenate([box.faces, [[0, 1, 8]]]), process=False))
    result = import_meshes(tmp_path)
    assert all(model.mesh.is_volume for model in result.accepted)
    assert len(result.accepted) + len(result.refused) == 1


def test_a_surface_without_an_inside_is_refused(tmp_path: Path) -> None:
    _write(tmp_path, "sheet.ply", _box(0.1, 0.1, 1e-6))
    assert "a surface without an inside" in _only_reason(import_meshes(tmp_path))


def test_what_no_gripper_can_hold_is_refused_but_thin_walls_can_be_held(tmp_path: Path) -> None:
    solid = _box(0.2, 0.2, 0.15)
    pocket = _box(0.18, 0.18, 0.15)
    pocket.apply_translation([0.0, 0.0, 0.01])
    _write(tmp_path, "solid.ply", solid)
    _write(tmp_path, "crate.ply", trimesh.boolean.difference([solid, pocket], engine="manifold"))
    result = import_meshes(tmp_path)
    assert [model.name for model in result.accepted] == ["crate"]
    assert "nothing to grasp: it is 0.150 m thick" in result.refused[0].reason


def test_grasp_width_of_known_shapes() -> None:
    assert grasp_width(_box(0.03, 0.05, 0.1)) == pytest.approx(0.03, rel=0.01)
    assert grasp_width(build_mesh("pipe", {"radius": 0.05, "height": 0.1, "bore": 0.8})) == pytest.approx(0.01, rel=0.1)


def test_foreign_and_empty_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(b"\x00\xff not a mesh")
    (tmp_path / "b.glb").write_bytes(b"nor this")
    (tmp_path / "c.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex x\n")
    (tmp_path / "d.stl").write_bytes(b"")
    (tmp_path / "e.off").write_text("OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n")
    result = import_meshes(tmp_path)
    assert [refusal.path.name for refusal in result.refused] == ["a.obj", "b.glb", "c.ply", "d.stl", "e.off"]
    assert all("\n" not in refusal.reason and refusal.reason.startswith("it ") for refusal in result.refused)


def test_names_come_from_what_tells_objects_apart(tmp_path: Path) -> None:
    _write(tmp_path, "003_cracker_box/google_16k/textured.obj", _box())
    _write(tmp_path, "004_sugar_box/google_16k/textured.obj", _box(0.02, 0.05, 0.1))
    _write(tmp_path, "kitchen/mug blue.stl", _box(0.04, 0.05, 0.06))
    _write(tmp_path, "office/mug blue.stl", _box(0.04, 0.05, 0.07))
    _write(tmp_path, "table.stl", _box(0.04, 0.05, 0.08))
    names = [model.name for model in import_meshes(tmp_path).accepted]
    assert names == ["003_cracker_box", "004_sugar_box", "mug_blue", "office_mug_blue", "object_table"]


def test_other_copies_of_an_object_are_left_out(tmp_path: Path) -> None:
    _write(tmp_path, "003_cracker_box/google_16k/nontextured.stl", _box())
    _write(tmp_path, "003_cracker_box/google_16k/textured.obj", _box())
    result = import_meshes(tmp_path)
    assert [model.name for model in result.accepted] == ["003_cracker_box"]
    assert "another copy of nontextured.stl" in result.refused[0].reason


def test_colours_come_from_materials_and_vertices(tmp_path: Path) -> None:
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[200, 40, 10, 255])
    red = _box()
    red.visual = trimesh.visual.TextureVisuals(material=material)
    green = _box(0.04, 0.05, 0.06)
    green.visual.vertex_colors = np.tile([10, 180, 20, 255], (8, 1)).astype(np.uint8)
    _write(tmp_path, "a_red.glb", red)
    _write(tmp_path, "b_green.ply", green)
    _write(tmp_path, "c_plain.stl", _box(0.03, 0.03, 0.06))
    colours = [model.colour for model in import_meshes(tmp_path).accepted]
    np.testing.assert_allclose(colours[0], (200, 40, 10), atol=1)
    assert colours[1:] == [(10, 180, 20), GREY]


def test_huge_meshes_are_simplified(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.04)
    assert len(ball.faces) > 80_000
    _write(tmp_path, "ball.stl", ball)
    (model,) = import_meshes(tmp_path).accepted
    assert len(model.mesh.faces) <= 20_000
    assert model.mesh.volume == pytest.approx(ball.volume, rel=0.01)


def test_large_objects_are_not_heavy(tmp_path: Path) -> None:
    _write(tmp_path, "plank.stl", _box(0.1, 0.2, 0.5))
    (model,) = import_meshes(tmp_path).accepted
    assert model.mass == pytest.approx(HEAVIEST)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_scales_without_sense_are_refused(scale: float, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="a positive number of metres per unit"):
        import_meshes(tmp_path, scale)


def test_a_folder_without_meshes_is_refused_with_what_is_read(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="is not a folder"):
        import_meshes(tmp_path / "missing")
    with pytest.raises(InvalidInputError, match=", ".join(SUFFIXES)):
        import_meshes(tmp_path)
