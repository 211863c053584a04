"""Scenes: what is dropped rests on the table, and a file gives the scene back."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh

from regnet_core.data.objects.models import sample_object
from regnet_core.data.scenes.dropping import DropConfig, SceneError, make_scene
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.errors import InvalidInputError

FAMILIES = ("box", "cylinder", "can", "l_profile", "superquadric")


@pytest.fixture(scope="module")
def clutter() -> Scene:
    config = DropConfig(spread=0.03)  # narrow, so that the objects fall on each other
    return make_scene(len(FAMILIES), np.random.default_rng(2), families=FAMILIES, config=config)


def _deepest(inside: trimesh.Trimesh, points: np.ndarray) -> float:
    """How far the deepest of the points (N, 3) lies inside the mesh [m]; negative when all are outside."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(inside.vertices.astype(np.float32)), o3d.core.Tensor(inside.faces.astype(np.uint32))
    )
    return -float(scene.compute_signed_distance(o3d.core.Tensor(points.astype(np.float32))).numpy().min())


def test_objects_stand_on_the_table_or_on_each_other(clutter: Scene) -> None:
    meshes = clutter.world_meshes()
    lowest = np.array([mesh.bounds[0][2] for mesh in meshes]) - clutter.table_height
    assert lowest.min() > -0.0005, "nothing sinks into the table"
    assert abs(lowest.min()) < 0.0005, "something lies on the table"
    distances = []
    for i, mesh in enumerate(meshes):
        surface = np.concatenate([mesh.vertices, mesh.sample(2000, seed=0)])
        others = [_deepest(other, surface) for j, other in enumerate(meshes) if j != i]
        assert max(others) < 0.0005, "no two objects overlap"
        distances.append(max(others))
    resting_higher = lowest > 0.001
    assert np.all(np.array(distances)[resting_higher] > -0.002), "what is not on the table touches another object"


def test_poses_are_rigid_and_above_the_table(clutter: Scene) -> None:
    rotations = clutter.poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (5, 1, 1)), atol=1e-9)
    assert np.all(np.linalg.det(rotations) > 0.0)
    assert np.all(clutter.poses[:, 2, 3] > clutter.table_height)
    assert np.all(np.abs(clutter.poses[:, :2, 3]) < 0.4)


def test_names_are_numbered_in_the_order_of_the_drop(clutter: Scene) -> None:
    assert [model.name for model in clutter.objects] == [f"{i:02d}_{family}" for i, family in enumerate(FAMILIES)]


def test_the_same_seed_gives_the_same_scene(clutter: Scene) -> None:
    config = DropConfig(spread=0.03)
    again = make_scene(len(FAMILIES), np.random.default_rng(2), families=FAMILIES, config=config)
    np.testing.assert_array_equal(clutter.poses, again.poses)
    other = make_scene(1, np.random.default_rng(3), families=FAMILIES[:1], config=config)
    assert not np.allclose(clutter.poses[0], other.poses[0])


def test_an_empty_table() -> None:
    scene = make_scene(0, np.random.default_rng(0))
    assert scene.objects == () and scene.poses.shape == (0, 4, 4) and scene.world_meshes() == []
    assert scene.table_mesh().bounds[1][2] == pytest.approx(0.75)


def test_a_scene_that_always_falls_off_is_an_error() -> None:
    config = DropConfig(spread=50.0, redrops=2, attempts=2)
    with pytest.raises(SceneError, match="1 objects did not come to rest on the table in 2 attempts"):
        make_scene(1, np.random.default_rng(1), families=["box"], config=config)


def test_a_saved_scene_is_loaded_as_it_was(clutter: Scene, tmp_path: Path) -> None:
    path = tmp_path / "scene.glb"
    clutter.save(path)
    loaded = Scene.load(path)
    assert loaded.table == clutter.table
    np.testing.assert_allclose(loaded.poses, clutter.poses, atol=1e-9)
    for before, after in zip(clutter.objects, loaded.objects, strict=True):
        assert (after.name, after.family, after.colour) == (before.name, before.family, before.colour)
        assert after.params == before.params
        assert (after.density, after.friction) == (before.density, before.friction)
        assert after.mesh.is_watertight
        np.testing.assert_array_equal(after.mesh.faces, before.mesh.faces)
        np.testing.assert_allclose(after.mesh.vertices, before.mesh.vertices, atol=1e-7)


def test_a_saved_scene_is_the_same_file_twice(clutter: Scene, tmp_path: Path) -> None:
    for name in ("a.glb", "b.glb"):
        clutter.save(tmp_path / name)
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def _table_mesh() -> trimesh.Trimesh:
    table = default_table()
    return trimesh.creation.box(bounds=(table.lower, table.upper))


def test_a_file_without_a_table_is_refused(tmp_path: Path) -> None:
    trimesh.Scene({"brick": trimesh.creation.box()}).export(tmp_path / "other.glb")
    with pytest.raises(InvalidInputError, match=r"no node named 'table'; its nodes are \['brick'\]"):
        Scene.load(tmp_path / "other.glb")


def test_a_file_without_the_extras_is_refused(tmp_path: Path) -> None:
    meshes = {"brick": trimesh.creation.box(), "table": _table_mesh()}
    trimesh.Scene(meshes).export(tmp_path / "other.glb")
    with pytest.raises(InvalidInputError, match=r"object 'brick' of .* lacks"):
        Scene.load(tmp_path / "other.glb")


def test_names_must_be_unique_and_poses_must_match() -> None:
    model = sample_object(np.random.default_rng(0), "box")
    with pytest.raises(InvalidInputError, match="names are unique"):
        Scene((model, model), np.tile(np.eye(4), (2, 1, 1)), default_table())
    with pytest.raises(InvalidInputError, match=r"got \(2, 4, 4\)"):
        Scene((model,), np.tile(np.eye(4), (2, 1, 1)), default_table())
