"""Grasps as a batch: shapes, files, frames, ranking."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnet_core import Grasps, Gripper, InvalidInputError
from regnet_core.geometry import pose_matrix


@pytest.fixture
def grasps() -> Grasps:
    rng = np.random.default_rng(1)
    rotation = Rotation.random(7, random_state=2).as_matrix()
    return Grasps.from_poses(
        rotation, rng.normal(size=(7, 3)), rng.uniform(0.03, 0.08, 7), rng.random(7), rng.random(7)
    )


def same(a: Grasps, b: Grasps) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in vars(a))


def test_a_file_gives_back_the_same_arrays_under_their_names(grasps: Grasps, tmp_path: Path) -> None:
    grasps.save(tmp_path / "g.npz")
    assert same(Grasps.load(tmp_path / "g.npz"), grasps)
    names = {"rotation", "translation", "width", "quality", "vertical_score", "confidence"}
    assert set(np.load(tmp_path / "g.npz").files) == names


def test_an_empty_batch_survives_its_file(tmp_path: Path) -> None:
    Grasps.empty().save(tmp_path / "none.npz")
    assert len(Grasps.load(tmp_path / "none.npz")) == 0


def test_a_file_that_holds_something_else_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", points=np.zeros((3, 3)))
    with pytest.raises(InvalidInputError, match="lacks rotation"):
        Grasps.load(tmp_path / "x.npz")
    np.savez(tmp_path / "pickled.npz", rotation=np.array([{}], dtype=object), **{n: np.zeros(1) for n in "ab"})
    with pytest.raises((InvalidInputError, ValueError)):
        Grasps.load(tmp_path / "pickled.npz")


def test_shapes_are_checked(grasps: Grasps) -> None:
    with pytest.raises(InvalidInputError, match=r"width must have shape \(7,\), got \(3,\)"):
        Grasps(*(grasps.width[:3] if n == "width" else getattr(grasps, n) for n in vars(grasps)))
    with pytest.raises(InvalidInputError, match=r"translation must have shape \(1, 3\)"):
        Grasps.from_poses(np.eye(3)[None], np.zeros(3), [0.05], [1.0])


def test_indexing_keeps_everything_together(grasps: Grasps) -> None:
    assert same(grasps[2], grasps[[2]])
    assert same(Grasps.concatenate([grasps[:3], grasps[3:]]), grasps)
    mask = grasps.quality > 0.5
    assert np.array_equal(grasps[mask].translation, grasps.translation[mask])
    assert [len(g) for g in grasps] == [1] * 7


def test_ranking_is_by_quality_and_stable() -> None:
    quality = [0.2, 0.9, 0.9, 0.5]
    batch = Grasps.from_poses(np.tile(np.eye(3), (4, 1, 1)), np.arange(12).reshape(4, 3), [0.05] * 4, quality)
    assert batch.ranked().translation[:, 0].tolist() == [3, 6, 9, 0]


def test_there_and_back_again_is_the_same_grasp(grasps: Grasps) -> None:
    transform = pose_matrix((0.3, -0.2, 1.0), (0.0, 0.0, 2.5))
    moved = grasps.transformed(transform)
    back = moved.transformed(np.linalg.inv(transform))
    assert np.allclose(back.rotation, grasps.rotation, atol=1e-12)
    assert np.allclose(back.translation, grasps.translation, atol=1e-12)
    assert np.allclose(moved.vertical_score, grasps.vertical_score)
    assert (moved.closing[:, 0] >= 0).all()


def test_fingertips_and_tool_frame_by_hand() -> None:
    down = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    one = Grasps.from_poses(down[None], [[0.1, 0.2, 0.9]], [0.05], [1.0])
    assert np.allclose(one.fingertips(Gripper(depth=0.06)), [[0.1, 0.2, 0.84]])
    tool = np.eye(4)
    tool[0, 3] = -0.1  # a flange 10 cm behind the grasp centre
    assert np.allclose(one.tool_poses(tool)[0, :3, 3], [0.1, 0.2, 1.0])


@pytest.mark.parametrize("field", ["rotation", "width"])
def test_arrays_of_texts_are_refused(field: str, grasps: Grasps, tmp_path: Path) -> None:
    arrays = dict(vars(grasps)) | {field: np.full(getattr(grasps, field).shape, "abc")}
    with pytest.raises(InvalidInputError, match=f"{field} must be an array of numbers"):
        Grasps(**arrays)
    np.savez(tmp_path / "texts.npz", **arrays)
    with pytest.raises(InvalidInputError, match=f"{field} must be an array of numbers"):
        Grasps.load(tmp_path / "texts.npz")


def test_files_that_are_no_archive_of_arrays_are_refused_by_name(grasps: Grasps, tmp_path: Path) -> None:
    with (tmp_path / "array.npz").open("wb") as stream:
        np.save(stream, np.zeros(3))
    (tmp_path / "text.npz").write_text("no grasps")
    (tmp_path / "empty.npz").touch()
    np.savez(tmp_path / "pickled.npz", **(dict(vars(grasps)) | {"width": np.array([{}], object)}))
    grasps.save(tmp_path / "cut.npz")
    content = (tmp_path / "cut.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[:100] + bytes(200) + content[300:])
    for name in ("array", "text", "empty", "pickled", "cut", "missing"):
        with pytest.raises(InvalidInputError, match=f"{name}.npz'"):
            Grasps.load(tmp_path / f"{name}.npz")
