"""Made-up clouds as PointCloud2 messages, and the table of malformed and unusual ones."""

from __future__ import annotations

import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

INT8, UINT8, INT16, UINT16, INT32, UINT32, FLOAT32, FLOAT64 = range(1, 9)
TABLE = 0.75
_NUMPY = {INT16: "i2", UINT8: "u1", UINT16: "u2", UINT32: "u4", FLOAT32: "f4", FLOAT64: "f8"}


def box_on_table(size: tuple[float, float, float] = (0.05, 0.14, 0.09), spacing: float = 0.004) -> np.ndarray:
    """A box at the origin of a table-top 0.75 m high, its top and sides seen, without noise -> (N, 3) [m]."""
    x, y, z = size
    table = _grid(0.5, 0.5, spacing)
    table = table[(np.abs(table[:, 0]) > x / 2) | (np.abs(table[:, 1]) > y / 2)]
    front, side = _grid(y, z, spacing)[:, [2, 0, 1]], _grid(x, z, spacing)[:, [0, 2, 1]]
    faces = [_moved(front, x=s * x / 2, z=z / 2) for s in (-1, 1)]
    faces += [_moved(side, y=s * y / 2, z=z / 2) for s in (-1, 1)]
    return _moved(np.concatenate([table, _moved(_grid(x, y, spacing), z=z), *faces]), z=TABLE)


def _moved(points: np.ndarray, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return points + np.array([x, y, z])


def _grid(length: float, width: float, spacing: float) -> np.ndarray:
    u, v = (np.arange(-s / 2, s / 2 + 1e-9, spacing) for s in (length, width))
    flat = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.column_stack([flat, np.zeros(len(flat))])


def field(name: str, offset: int, datatype: int = FLOAT32, count: int = 1) -> PointField:
    return PointField(name=name, offset=offset, datatype=datatype, count=count)


XYZ = (field("x", 0), field("y", 4), field("z", 8))


def cloud(
    points: np.ndarray,
    *,
    frame: str = "world",
    stamp: int = 1,
    fields: Sequence[PointField] = XYZ,
    point_step: int = 12,
    big_endian: bool = False,
    rows: int = 1,
    row_padding: int = 0,
    extra: dict[str, Any] | None = None,
) -> PointCloud2:
    """A cloud with the given layout. ``extra`` holds the values (N,) of fields other than x, y, z; padding is 0xAB."""
    values = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2], **(extra or {})}
    order = ">" if big_endian else "<"
    width = len(points) // rows
    row_step = width * point_step + row_padding
    buffer = np.full((rows, row_step), 0xAB, np.uint8)
    for f in fields:
        dtype = np.dtype(order + _NUMPY[f.datatype])
        raw = (
            np.ascontiguousarray(np.asarray(values[f.name]).astype(dtype))
            .view(np.uint8)
            .reshape(rows, width, dtype.itemsize)
        )
        cells = buffer[:, : width * point_step].reshape(rows, width, point_step)
        cells[..., f.offset : f.offset + dtype.itemsize] = raw
        buffer[:, : width * point_step] = cells.reshape(rows, -1)
    return PointCloud2(
        header=Header(stamp=Time(sec=stamp), frame_id=frame),
        height=rows,
        width=width,
        fields=list(fields),
        is_bigendian=big_endian,
        point_step=point_step,
        row_step=row_step,
        data=array.array("B", buffer.tobytes()),
        is_dense=bool(np.isfinite(points).all()),
    )


@dataclass(frozen=True)
class OddCloud:
    """A cloud that a careless node would stumble over."""

    name: str
    make: Callable[[], PointCloud2]
    decoder: str = ""
    """Regular expression of the error with which decoding refuses the message; empty: it decodes."""
    detector: str = ""
    """Regular expression of the reason that the detector gives; empty: it finds grasps."""
    preprocessor: str = ""
    """Regular expression of the preprocessor's message; empty: it publishes a cloud and is content."""


def _broken(name: str, text: str, **changes: Any) -> OddCloud:
    """A good cloud with some attributes of the message changed, which nobody can decode."""

    def make() -> PointCloud2:
        message = cloud(SCENE)
        for attribute, value in changes.items():
            setattr(message, attribute, value)
        return message

    return OddCloud(name, make, decoder=text, detector=text, preprocessor=text)


def _empty(name: str, points: np.ndarray, detector: str, preprocessor: str = "") -> OddCloud:
    """A cloud that decodes but holds nothing to grasp."""
    return OddCloud(name, lambda: cloud(points), detector=detector, preprocessor=preprocessor)


def _fine(name: str, make: Callable[[], PointCloud2]) -> OddCloud:
    """An unusual cloud that is as good as any."""
    return OddCloud(name, make)


def _with_nan(share: float) -> np.ndarray:
    points = SCENE.copy()
    points[np.random.default_rng(1).random(len(points)) < share] = np.nan
    return points


def _even(points: np.ndarray, rows: int) -> np.ndarray:
    return points[: len(points) // rows * rows]


SCENE = box_on_table()
_N = len(SCENE)
_NO_POINT = r"(none of the .*points is|none of the cloud's .*points is)"
_NO_SURFACE = r"(no surface|usable points|no .*grasp|none of|rejected)"
_RGB = np.full(_N, 0x00FF8040, np.uint32)

ODD_CLOUDS = (
    _empty("no point", SCENE[:0], r"the cloud is empty|no points", r"the cloud has no points"),
    _empty("one point", SCENE[:1], _NO_SURFACE),
    _empty("three points", SCENE[:3], _NO_SURFACE),
    _empty("all NaN", np.full((500, 3), np.nan), _NO_POINT, _NO_POINT),
    _empty("all infinite", np.full((500, 3), np.inf), _NO_POINT, _NO_POINT),
    _empty("all minus infinite", np.full((500, 3), -np.inf), _NO_POINT, _NO_POINT),
    _empty("all far away", SCENE + 1e6, _NO_POINT, _NO_POINT),
    _empty("the largest floats", np.full((500, 3), 3e38), _NO_POINT, _NO_POINT),
    _empty("all identical", np.tile([0.1, 0.2, 0.8], (5000, 1)), _NO_SURFACE),
    _empty("all on one line", np.linspace([0, 0, 0.8], [0.3, 0, 0.8], 5000), _NO_SURFACE),
    _empty("only a table", _moved(_grid(0.5, 0.5, 0.004), z=TABLE), r"support plane|table"),
    _empty("a wall without a table", _grid(0.5, 0.5, 0.004)[:, [2, 0, 1]], _NO_SURFACE),
    _fine("a third NaN", lambda: cloud(_with_nan(0.33))),
    _fine("some infinite", lambda: cloud(np.concatenate([SCENE, np.full((100, 3), np.inf)]))),
    _fine("some far away", lambda: cloud(np.concatenate([SCENE, np.full((100, 3), 1e9)]))),
    _fine("negative coordinates", lambda: cloud(SCENE - [3.0, 3.0, 3.0])),
    _fine("big-endian", lambda: cloud(SCENE, big_endian=True)),
    _fine("organised", lambda: cloud(_even(SCENE, 16), rows=16)),
    _fine("organised with padded rows", lambda: cloud(_even(SCENE, 16), rows=16, row_padding=20)),
    _fine("big-endian with padded rows", lambda: cloud(_even(SCENE, 8), rows=8, row_padding=7, big_endian=True)),
    _fine("padded points", lambda: cloud(SCENE, point_step=32)),
    _fine("unaligned", lambda: cloud(SCENE, fields=(field("x", 1), field("y", 5), field("z", 9)), point_step=13)),
    _fine("fields in another order", lambda: cloud(SCENE, fields=(field("z", 0), field("x", 4), field("y", 8)))),
    _fine(
        "float64",
        lambda: cloud(
            SCENE, fields=(field("x", 0, FLOAT64), field("y", 8, FLOAT64), field("z", 16, FLOAT64)), point_step=24
        ),
    ),
    _fine(
        "mixed float32 and float64",
        lambda: cloud(SCENE, fields=(field("x", 0, FLOAT64), field("y", 8), field("z", 12)), point_step=16),
    ),
    _fine(
        "extra fields",
        lambda: cloud(
            SCENE,
            fields=(*XYZ, field("intensity", 12), field("ring", 16, UINT16)),
            point_step=20,
            extra={"intensity": np.arange(_N), "ring": np.arange(_N) % 64},
        ),
    ),
    _fine(
        "colours packed in a float32",
        lambda: cloud(SCENE, fields=(*XYZ, field("rgb", 12)), point_step=16, extra={"rgb": _RGB.view(np.float32)}),
    ),
    _fine(
        "colours that are NaN as floats",
        lambda: cloud(
            SCENE,
            fields=(*XYZ, field("rgb", 12)),
            point_step=16,
            extra={"rgb": (_RGB | 0x7FC00000).view(np.float32)},
        ),
    ),
    _fine(
        "colours packed in a uint32",
        lambda: cloud(SCENE, fields=(*XYZ, field("rgba", 12, UINT32)), point_step=16, extra={"rgba": _RGB}),
    ),
    _fine(
        "colours in three bytes",
        lambda: cloud(
            SCENE,
            fields=(*XYZ, field("r", 12, UINT8), field("g", 13, UINT8), field("b", 14, UINT8)),
            point_step=16,
            extra={c: np.full(_N, i, np.uint8) for i, c in enumerate("rgb")},
        ),
    ),
    _fine("bytes after the last point", lambda: _appended(cloud(SCENE), 100)),
    _broken("no fields", r"lacks the field\(s\) x, y, z", fields=[]),
    _broken("no x", r"lacks the field\(s\) x", fields=[field("y", 4), field("z", 8)]),
    _broken("no y", r"lacks the field\(s\) y", fields=[field("x", 0), field("z", 8)]),
    _broken("no z", r"lacks the field\(s\) z", fields=[field("x", 0), field("y", 4)]),
    _broken(
        "int16 coordinates", r"must be FLOAT32.*INT16", fields=[field(n, 2 * i, INT16) for i, n in enumerate("xyz")]
    ),
    _broken("uint8 x", r"'x' must be FLOAT32.*UINT8", fields=[field("x", 0, UINT8), *XYZ[1:]]),
    _broken("unknown datatype", r"unknown datatype 77", fields=[field("x", 0, 77), *XYZ[1:]]),
    _broken("datatype 0", r"unknown datatype 0", fields=[field("x", 0, 0), *XYZ[1:]]),
    _broken("count of 3", r"'x' must have count 1, got 3", fields=[field("x", 0, FLOAT32, 3), *XYZ[1:]]),
    _broken("duplicated field", r"two fields named 'x'", fields=[field("x", 0), *XYZ]),
    _broken("offset outside of the point", r"'z' covers bytes 10 to 14", fields=[*XYZ[:2], field("z", 10)]),
    _broken("offset near 2^32", r"'z' covers bytes 4294967295", fields=[*XYZ[:2], field("z", 2**32 - 1)]),
    _broken("point_step 0", r"point_step is 0", point_step=0),
    _broken("point_step too small", r"point_step is 8", point_step=8),
    _broken("row_step too small", r"row_step is 24 bytes", height=2, width=100, row_step=24),
    _broken("row_step 0 with rows", r"row_step is 0 bytes", height=2, width=100, row_step=0),
    _broken("truncated data", r"truncated", data=array.array("B", bytes(1001))),
    _broken("no data", r"truncated", data=array.array("B")),
    _broken("wider than the data", r"truncated", width=_N + 1),
    _broken("as large as can be written", r"truncated|row_step", height=2**32 - 1, width=2**32 - 1, row_step=2**32 - 1),
    OddCloud("zero stamp", lambda: cloud(SCENE, stamp=0), preprocessor=r"stamp is zero"),
    OddCloud("empty frame", lambda: cloud(SCENE, frame=""), detector=r"no frame_id", preprocessor=r"no frame_id"),
    OddCloud(
        "wrong frame",
        lambda: cloud(SCENE, frame="camera_optical"),
        detector=r"in frame 'camera_optical', but .* target_frame",
        preprocessor=r"in frame 'camera_optical', not in 'world'|no transform from 'camera_optical'",
    ),
)


def _appended(message: PointCloud2, count: int) -> PointCloud2:
    message.data = array.array("B", bytes(message.data) + bytes(count))
    return message


def huge_cloud(count: int) -> PointCloud2:
    """The scene many times over, ``count`` points in all."""
    return cloud(np.tile(SCENE, (count // _N + 1, 1))[:count])
