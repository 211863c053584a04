"""Readers of point clouds on buffers and files that are written by other means: struct, numpy and Open3D."""

import array
import struct
from pathlib import Path

import numpy as np
import open3d
import pytest

from regnet_core import CloudError
from regnet_core.io.files import read_cloud_file
from regnet_core.io.pointcloud2 import FLOAT32, FLOAT64, UINT8, UINT16, UINT32, Field, decode_cloud, encode_cloud

POINTS = np.array([[0.1, -0.2, 0.75], [np.nan, 0.0, 0.8], [1.5, 2.5, -3.5], [0.25, 0.5, 1.0]], np.float32)
COLORS = np.array([[255, 0, 1], [2, 254, 3], [4, 5, 253], [120, 130, 140]], np.uint8)
PACKED = [r << 16 | g << 8 | b for r, g, b in COLORS.tolist()]
XYZ = [Field("x", 0, FLOAT32), Field("y", 4, FLOAT32), Field("z", 8, FLOAT32)]


# PointCloud2 buffers


def test_padded_big_endian_float64_points_with_any_field_order_are_decoded():
    rows = b""
    for row in (0, 2):
        for i in (row, row + 1):
            x, y, z = POINTS[i].astype(float)
            rows += b"\xee" + struct.pack(">ddI", z, x, PACKED[i]) + b"\xee\xee" + struct.pack(">d", y)
        rows += b"row padding"
    fields = [Field("z", 1, FLOAT64), Field("x", 9, FLOAT64), Field("rgb", 17, UINT32), Field("y", 23, FLOAT64)]
    cloud = decode_cloud(fields, 2, 2, 31, 2 * 31 + 11, True, rows)
    assert cloud.points.dtype == np.float64
    np.testing.assert_array_equal(cloud.points, POINTS.astype(float))
    np.testing.assert_array_equal(cloud.colors, COLORS)


@pytest.mark.parametrize("buffer", [bytes, bytearray, memoryview, lambda b: array.array("B", b), list])
def test_any_kind_of_buffer_is_accepted(buffer):
    data = b"".join(struct.pack("<fff", *p) for p in POINTS.tolist())
    cloud = decode_cloud(XYZ, 4, 1, 12, 48, False, buffer(data))
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.colors is None


def test_three_separate_channels_are_colours_and_other_fields_are_ignored():
    fields = [*XYZ, *(Field(name, 12 + i, UINT8) for i, name in enumerate("rgb")), Field("label", 15, UINT8)]
    data = b"".join(struct.pack("<fff4B", *p, *c, 9) for p, c in zip(POINTS.tolist(), COLORS.tolist(), strict=True))
    np.testing.assert_array_equal(decode_cloud(fields, 4, 1, 16, 64, False, data).colors, COLORS)


def test_row_step_of_a_single_row_and_bytes_behind_the_last_point_do_not_matter():
    data = b"".join(struct.pack("<fff", *p) for p in POINTS.tolist())
    np.testing.assert_array_equal(decode_cloud(XYZ, 4, 1, 12, 0, False, data + b"rest").points, POINTS)


def test_an_empty_message_is_an_empty_cloud():
    assert decode_cloud(XYZ, 0, 1, 12, 0, False, b"").points.shape == (0, 3)


def test_encode_then_decode_gives_points_and_colours_back():
    fields, step, data = encode_cloud(POINTS, COLORS)
    cloud = decode_cloud(fields, 4, 1, step, 4 * step, False, data)
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert struct.unpack_from("<fff", data, step) == pytest.approx(tuple(POINTS[1]), nan_ok=True)


DATA = bytes(48)


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("truncated.*need 48 bytes, got 47", (XYZ, 4, 1, 12, 48, False, DATA[:-1])),
        ("truncated", (XYZ, 2**32 - 1, 1, 12, 48, False, DATA)),
        ("row_step is 20 bytes, but 2 points of 12 bytes need at least 24", (XYZ, 2, 2, 12, 20, False, DATA)),
        ("lacks the field.*z; its fields are: x, y", (XYZ[:2], 4, 1, 12, 48, False, DATA)),
        ("lacks the field.*x, y, z; its fields are: none", ([], 4, 1, 12, 48, False, DATA)),
        ("'x' must be FLOAT32.*got UINT16", ([Field("x", 0, UINT16), *XYZ[1:]], 4, 1, 12, 48, False, DATA)),
        ("unknown datatype 77", ([Field("x", 0, 77), *XYZ[1:]], 4, 1, 12, 48, False, DATA)),
        ("count 1, got 3", ([Field("x", 0, FLOAT32, 3), *XYZ[1:]], 4, 1, 12, 48, False, DATA)),
        ("two fields named 'x'", ([*XYZ, XYZ[0]], 4, 1, 12, 48, False, DATA)),
        ("'z' covers bytes 8 to 12.*point_step is 10", (XYZ, 4, 1, 10, 40, False, DATA)),
        ("'rgb' covers", ([*XYZ, Field("rgb", 12, FLOAT32)], 4, 1, 12, 48, False, DATA)),
        ("buffer of bytes, got str", (XYZ, 4, 1, 12, 48, False, "x" * 48)),
    ],
)
def test_a_message_that_contradicts_itself_is_refused_with_the_numbers(message, arguments):
    with pytest.raises(CloudError, match=message):
        decode_cloud(*arguments)


@pytest.mark.parametrize(
    ("points", "colors"), [(np.zeros((3, 2)), None), (np.zeros((3, 3)), np.zeros((3, 3))), ([["a", "b", "c"]], None)]
)
def test_only_points_and_byte_colours_can_be_encoded(points, colors):
    with pytest.raises(CloudError, match="must be"):
        encode_cloud(points, colors)


# Files


def pcd(path: Path, kind: str, body: bytes, points: int = 4, fields: str = "x y z rgb") -> Path:
    count = len(fields.split())
    header = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {'4 ' * count}\nTYPE {'F ' * (count - 1)}U\n"
    header += f"COUNT {'1 ' * count}\nWIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {kind}\n"
    path.write_bytes(header.encode() + body)
    return path


BINARY_BODY = b"".join(struct.pack("<fffI", *p, c) for p, c in zip(POINTS.tolist(), PACKED, strict=True))


def test_pcd_ascii_and_binary(tmp_path):
    text = "".join(f"{x} {y} {z} {c}\n" for (x, y, z), c in zip(POINTS.tolist(), PACKED, strict=True))
    for kind, body in (("ascii", text.encode()), ("binary", BINARY_BODY)):
        cloud = read_cloud_file(pcd(tmp_path / "cloud.pcd", kind, body))
        np.testing.assert_array_equal(cloud.points, POINTS)
        np.testing.assert_array_equal(cloud.colors, COLORS)


def test_pcd_compressed(tmp_path):
    rng = np.random.default_rng(0)
    points, colors = np.repeat(rng.random((100, 3)), 5, axis=0), rng.integers(0, 256, (500, 3))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.colors = open3d.utility.Vector3dVector(colors / 255)
    open3d.io.write_point_cloud(str(tmp_path / "cloud.pcd"), cloud, compressed=True)
    assert b"binary_compressed" in (tmp_path / "cloud.pcd").read_bytes()
    read = read_cloud_file(tmp_path / "cloud.pcd")
    np.testing.assert_allclose(read.points, points, atol=1e-7)
    np.testing.assert_array_equal(read.colors, colors)


def ply_header(encoding: str, scalar: str = "float", count: int = 4) -> bytes:
    lines = ["ply", f"format {encoding} 1.0", f"element vertex {count}"]
    lines += [f"property {scalar} {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header\n"]
    return "\n".join(lines).encode()


def test_ply_ascii_and_both_binary_orders(tmp_path):
    file = tmp_path / "cloud.ply"
    rows = list(zip(POINTS.tolist(), COLORS.tolist(), strict=True))
    text = "".join(" ".join(map(str, (*p, *c))) + "\n" for p, c in rows) + "3 0 1 2\n"
    bodies = {"ascii": text.encode()}
    for encoding, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
        vertices = b"".join(struct.pack(order + "fff3B", *p, *c) for p, c in rows)
        bodies[encoding] = vertices + struct.pack(order + "Biii", 3, 0, 1, 2)
    for encoding, body in bodies.items():
        file.write_bytes(ply_header(encoding) + body)
        cloud = read_cloud_file(file)
        np.testing.assert_array_equal(cloud.points, POINTS, err_msg=encoding)
        np.testing.assert_array_equal(cloud.colors, COLORS, err_msg=encoding)


def test_ply_doubles_keep_their_precision(tmp_path):
    points = np.array([[1 / 3, 2 / 3, 1e-9]])
    file = tmp_path / "cloud.ply"
    file.write_bytes(ply_header("binary_little_endian", "double", 1) + struct.pack("<ddd3B", *points[0], 1, 2, 3))
    np.testing.assert_array_equal(read_cloud_file(file).points, points)


def test_npy_and_npz(tmp_path):
    np.save(tmp_path / "three.npy", POINTS)
    np.save(tmp_path / "six.npy", np.hstack([POINTS, COLORS / 255]))
    np.savez(tmp_path / "both.npz", points=POINTS.astype(float), colors=COLORS)
    np.savez(tmp_path / "points.npz", points=POINTS)
    assert read_cloud_file(tmp_path / "three.npy").colors is None
    for name in ("six.npy", "both.npz"):
        cloud = read_cloud_file(tmp_path / name)
        np.testing.assert_array_equal(cloud.points, POINTS.astype(cloud.points.dtype), err_msg=name)
        np.testing.assert_array_equal(cloud.colors, COLORS, err_msg=name)
    assert read_cloud_file(tmp_path / "points.npz").colors is None


def broken_files(folder: Path) -> dict[str, str]:
    """Files that are no point clouds, and what the error must say of each."""
    pcd(folder / "short.pcd", "binary", BINARY_BODY[:-16])
    pcd(folder / "no_z.pcd", "ascii", b"1 2 3\n" * 4, fields="x y rgb")
    (folder / "no_fields.pcd").write_text("# .PCD v0.7\nVERSION 0.7\nWIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA ascii\n")
    (folder / "no_xy.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float z\nend_header\n1\n")
    pcd(folder / "garbage.pcd", "binary_compressed", b"\xff" * 40)
    (folder / "text.pcd").write_text("these are not points\n")
    (folder / "empty.pcd").write_bytes(b"")
    (folder / "short.ply").write_bytes(ply_header("binary_little_endian") + BINARY_BODY[:20])
    (folder / "no_end.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\n")
    (folder / "faces.ply").write_bytes(b"ply\nformat ascii 1.0\nelement face 0\nend_header\n")
    (folder / "text.ply").write_text("these are not points\n")
    np.save(folder / "flat.npy", np.zeros(12))
    np.save(folder / "words.npy", np.array([["a", "b", "c"]]))
    np.save(folder / "pickled.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    np.savez(folder / "other.npz", cloud=POINTS)
    np.savez(folder / "unequal.npz", points=POINTS, colors=COLORS[:2])
    (folder / "text.npz").write_text("these are not points\n")
    return {
        "short.pcd": "truncated.*promises 4 points, it holds 3",
        "no_z.pcd": "lacks z; it has: x, y, rgb",
        "no_fields.pcd": "cannot be read as .pcd: fields: Field required; size: Field required",
        "no_xy.ply": "lacks x, y; it has: z",
        "garbage.pcd": "cannot be read as .pcd",
        "text.pcd": "cannot be read as .pcd",
        "empty.pcd": "cannot be read as .pcd",
        "short.ply": "cannot be read as .ply|truncated",
        "no_end.ply": "cannot be read as .ply",
        "faces.ply": "no element 'vertex'",
        "text.ply": "cannot be read as .ply",
        "flat.npy": r"must have shape \(N, 3\) or \(N, 6\), got \(12,\)",
        "words.npy": "must be numbers",
        "pickled.npy": "cannot be read as .npy",
        "other.npz": "must hold an array 'points', it holds cloud",
        "unequal.npz": "one row for each of the 4 points, got 2",
        "text.npz": "not an .npz archive",
        "missing.pcd": "there is no file",
        "cloud.xyz": "unknown suffix '.xyz'; point clouds are read from .pcd, .ply, .npy, .npz",
    }


def test_every_broken_file_is_refused_by_name_in_one_line(tmp_path):
    for name, message in broken_files(tmp_path).items():
        with pytest.raises(CloudError, match=message) as caught:
            read_cloud_file(tmp_path / name)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value), name
