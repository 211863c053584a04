"""The files of a data set: what is written comes back, compactly, and what is damaged is refused."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import zstandard
from scipy.spatial.transform import Rotation

from regnet_core.coder import canonical_rotation, decode_orientation
from regnet_core.data.cameras.camera import KINECT_V2, Camera, look_at
from regnet_core.data.cameras.rendering import NOTHING_ID, TABLE_ID, View
from regnet_core.data.labels.scene_labels import GraspLabels
from regnet_core.data.storage.archive import view_points
from regnet_core.data.storage.compact import from_steps, pack, to_steps, unpack
from regnet_core.data.storage.records import (
    SceneInfo,
    ViewInfo,
    info_from_bytes,
    info_to_bytes,
    labels_from_bytes,
    labels_to_bytes,
    view_from_bytes,
    view_to_bytes,
)
from regnet_core.data.storage.tars import index_tar, read_tar, write_tar, write_whole
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Box


def _labels(count: int, seed: int) -> GraspLabels:
    rng = np.random.default_rng(seed)
    return GraspLabels(
        rng.uniform(-0.5, 1.5, (count, 3)),
        canonical_rotation(Rotation.random(count, rng=rng).as_matrix()) if count else np.zeros((0, 3, 3)),
        rng.uniform(0, 1, count),
        rng.uniform(-0.06, 0.06, (count, 2)),
        rng.uniform(0, 0.06, count),
        rng.integers(0, 20, count),
    )


def _view(seed: int = 0) -> View:
    rng = np.random.default_rng(seed)
    shape = (KINECT_V2.height, KINECT_V2.width)
    depth = np.full(shape, np.nan)
    depth[100:200, 150:300] = rng.uniform(0.5, 3.0, (100, 150))
    depth[120, 160] = np.nan
    ids = np.full(shape, NOTHING_ID)
    ids[100:150, 150:300], ids[150:200, 150:300] = TABLE_ID, 3
    camera = Camera(KINECT_V2, look_at((0.6, -0.4, 1.4), (0.0, 0.0, 0.75)))
    return View(camera, depth, np.zeros((*shape, 3)), ids, rng.integers(0, 256, (*shape, 3), dtype=np.uint8))


WINDOW = (slice(100, 200), slice(150, 300))


def test_labels_come_back_within_their_steps() -> None:
    written = [_labels(200, 0), _labels(0, 1), _labels(7, 2)]
    data = labels_to_bytes(written)
    assert data == labels_to_bytes(written)
    read = labels_from_bytes(data)
    assert [len(one) for one in read] == [200, 0, 7]
    for before, after in zip(written, read, strict=True):
        np.testing.assert_allclose(after.translation, before.translation, atol=2.6e-5)
        np.testing.assert_allclose(after.rotation, before.rotation, atol=2e-4)
        np.testing.assert_allclose(after.score, before.score, atol=1e-5)
        np.testing.assert_allclose(after.contacts, before.contacts, atol=2.6e-5)
        np.testing.assert_allclose(after.entry, before.entry, atol=2.6e-5)
        np.testing.assert_array_equal(after.object_index, before.object_index)


def test_rotations_stay_canonical_and_contacts_go_with_them() -> None:
    rng = np.random.default_rng(0)
    # Closing directions just beside the border of the canonical form, x = 0.
    angle = rng.uniform(-1.0, 1.0, 500)
    r = np.column_stack([rng.uniform(0.0, 3e-5, 500), np.cos(angle), np.sin(angle)])
    rotation = canonical_rotation(decode_orientation(r, rng.uniform(-1.0, 1.0, 500)))
    written = dataclasses.replace(_labels(500, 1), rotation=rotation)
    (read,) = labels_from_bytes(labels_to_bytes([written]))
    np.testing.assert_array_equal(canonical_rotation(read.rotation), read.rotation)
    at = [one.contacts[:, :, None] * one.rotation[:, None, :, 1] for one in (written, read)]
    at[1] = np.where(np.einsum("mi,mi->m", *(one.rotation[:, :, 1] for one in (written, read)))[:, None, None] < 0,
                     at[1][:, ::-1], at[1])  # fmt: skip
    np.testing.assert_allclose(at[1], at[0], atol=6e-5)


def test_labels_take_little_space() -> None:
    assert len(labels_to_bytes([_labels(4000, 0)])) < 28 * 4000


def test_a_view_comes_back_within_its_steps() -> None:
    view = _view()
    confidence = np.random.default_rng(1).uniform(0, 1, (4, *view.depth.shape))
    read = view_from_bytes(view_to_bytes(view, confidence, WINDOW))
    np.testing.assert_allclose(read.depth, view.depth[WINDOW], atol=6e-5)
    np.testing.assert_array_equal(np.isnan(read.depth), np.isnan(view.depth[WINDOW]))
    np.testing.assert_array_equal(read.colours, view.colours[WINDOW])
    np.testing.assert_allclose(read.confidence, confidence[:, *WINDOW], atol=0.002)
    assert np.all(read.object_index[:50] == -1) and np.all(read.object_index[50:] == 3)


def test_points_of_a_stored_view_are_those_of_the_camera() -> None:
    view = _view()
    data = view_from_bytes(view_to_bytes(view, np.zeros((1, *view.depth.shape)), WINDOW))
    rows, columns = np.nonzero(np.isfinite(data.depth))
    points = view_points(ViewInfo("kinect_v2", view.camera, (100, 150)), data, rows, columns)
    np.testing.assert_allclose(points, view.world_points()[WINDOW][rows, columns], atol=2e-4)


def _info() -> SceneInfo:
    camera = Camera(KINECT_V2, look_at((0.6, -0.4, 1.4), (0.0, 0.0, 0.75)))
    boxes = (Box((-1.0, -1.0, 0.7), (1.0, 1.0, 0.75)), Box((0.0, 0.0, 0.75), (0.1, 0.1, 0.8)))
    poses = np.tile(np.eye(4), (2, 1, 1))
    views = (ViewInfo("kinect_v2", camera, (3, 4)),)
    return SceneInfo(12, "bin", ("a", "b"), poses, boxes[0], (boxes[1],), views, (0.06, 0.08), (10, 20), 1)


def test_a_scenes_json_comes_back() -> None:
    info = _info()
    read = info_from_bytes(info_to_bytes(info))
    assert info_to_bytes(read) == info_to_bytes(info)
    assert (read.key, read.objects, read.fixtures, read.found) == ("000012", ("a", "b"), info.fixtures, (10, 20))
    np.testing.assert_array_equal(read.views[0].camera.T_world_camera, info.views[0].camera.T_world_camera)


def test_another_schema_and_damage_are_refused() -> None:
    document = json.loads(info_to_bytes(_info()))
    with pytest.raises(InvalidInputError, match=r"schema 'regnet-scenes/9'; this version reads 'regnet-scenes/1'"):
        info_from_bytes(json.dumps({**document, "schema": "regnet-scenes/9"}).encode())
    del document["kind"]
    with pytest.raises(InvalidInputError, match="not the JSON of a scene"):
        info_from_bytes(json.dumps(document).encode())
    with pytest.raises(InvalidInputError, match="not the JSON of a scene"):
        info_from_bytes(b"\x80\x04K\x01.")
    with pytest.raises(InvalidInputError, match=r"000001\.grasps is not zstd-compressed safetensors"):
        labels_from_bytes(labels_to_bytes([_labels(20, 0)])[:-30], "000001.grasps")
    with pytest.raises(InvalidInputError, match="is not zstd-compressed"):
        unpack(b"garbage", "it")
    other = pack({"count": np.zeros(1, np.int32), "translation": np.zeros((2, 4))})
    with pytest.raises(InvalidInputError, match=r"it must hold translation of shape \(None, 3\), got \(2, 4\)"):
        labels_from_bytes(other, "it")
    with pytest.raises(InvalidInputError, match=r"the view must hold depth of shape \(None, None\), got None"):
        view_from_bytes(other)
    huge = zstandard.ZstdCompressor().compressobj(size=2**45)
    with pytest.raises(InvalidInputError, match="would take more than"):
        unpack(huge.compress(b"x") + huge.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK), "it")


def test_arrays_come_back_and_are_packed_the_same_way_twice() -> None:
    arrays = {"b": np.arange(12, dtype=np.uint16).reshape(3, 4), "a": np.ones((2, 2), np.float32)[:, ::-1]}
    read = unpack(pack(arrays), "it")
    assert pack(arrays) == pack(dict(reversed(arrays.items())))
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype


def test_numbers_that_do_not_fit_are_refused() -> None:
    np.testing.assert_allclose(from_steps(to_steps([-1.0, 0.5], 0.01, np.int16), 0.01), [-1.0, 0.5], rtol=1e-6)
    with pytest.raises(InvalidInputError, match=r"must lie in \[0, 6.5535\] to be stored in steps of 0.0001"):
        to_steps([7.0], 0.0001, np.uint16)


def test_tars_depend_on_their_members_only(tmp_path: Path) -> None:
    members = [("000001.json", b"{}"), ("000001.view0.st.zst", bytes(range(256)) * 5), ("empty", b"")]
    data = write_tar(members)
    assert data == write_tar(members) and read_tar(data, "it") == members
    write_whole(tmp_path / "deep" / "x.tar", data)
    extents = index_tar(tmp_path / "deep" / "x.tar")
    for name, content in members:
        assert data[extents[name].offset : extents[name].offset + extents[name].size] == content
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["x.tar"]


def test_a_tar_cut_short_is_refused(tmp_path: Path) -> None:
    data = write_tar([("a", b"1" * 3000), ("b", b"2" * 3000)])
    for length in (700, 2000, 3700, 5000):
        (tmp_path / "x.tar").write_bytes(data[:length])
        with pytest.raises(InvalidInputError, match=r"x\.tar' is (not a whole tar archive|cut short)"):
            index_tar(tmp_path / "x.tar")
    with pytest.raises(InvalidInputError, match="part 7 is not a whole tar archive"):
        read_tar(b"no tar at all", "part 7")
