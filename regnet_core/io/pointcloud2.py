"""The buffer of a ``sensor_msgs/PointCloud2``, decoded from and encoded to plain numbers (no ROS needed).

Layout (sensor_msgs/PointCloud2.msg): point (row, column) starts at byte ``row * row_step + column * point_step``; every
field of it lies ``offset`` bytes further. Rows and points may be padded, fields may come in any order or overlap.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from regnet_core.errors import CloudError

Colors = npt.NDArray[np.uint8]

INT8, UINT8, INT16, UINT16, INT32, UINT32, FLOAT32, FLOAT64 = range(1, 9)
"""sensor_msgs/PointField's codes of the scalar types."""

_NAMES = ("INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "FLOAT32", "FLOAT64")
_SIZES = (1, 1, 2, 2, 4, 4, 4, 8)
_AXES = ("x", "y", "z")
_PACKED = ("rgb", "rgba")
_CHANNELS = (("r", "g", "b"), ("red", "green", "blue"))


@dataclass(frozen=True)
class Field:
    """One field of every point; the same four numbers as ``sensor_msgs/PointField``."""

    name: str
    offset: int
    """Bytes from the start of the point."""
    datatype: int
    """1 to 8: INT8, UINT8, INT16, UINT16, INT32, UINT32, FLOAT32, FLOAT64."""
    count: int = 1


class FieldLike(Protocol):
    """Anything with a field's four attributes: ``Field``, or a PointField message itself."""

    @property
    def name(self) -> str: ...
    @property
    def offset(self) -> int: ...
    @property
    def datatype(self) -> int: ...
    @property
    def count(self) -> int: ...


class DecodedCloud(NamedTuple):
    """The points of a message in its own frame, row by row, invalid (NaN) points included."""

    points: npt.NDArray[np.floating[Any]]
    """(N, 3) [m], N = height * width; float64 where the message has float64 coordinates, otherwise float32. A view of
    the message's bytes where they hold just such numbers, and then only to be read."""
    colors: Colors | None
    """(N, 3) red, green, blue in 0..255; None when the message has no colours that can be read."""


class EncodedCloud(NamedTuple):
    """What a PointCloud2 of height 1 needs: little-endian, width N, row_step N * point_step."""

    fields: tuple[Field, ...]
    point_step: int
    data: bytes


def decode_cloud(
    fields: Iterable[FieldLike],
    width: int,
    height: int,
    point_step: int,
    row_step: int,
    is_bigendian: bool,
    data: Any,
) -> DecodedCloud:
    """Coordinates and colours of a PointCloud2.

    ``data`` is any buffer of bytes (bytes, array, memoryview, uint8 array). Colours are taken from a packed ``rgb`` or
    ``rgba`` field (0xAARRGGBB in 32 bits) or from three UINT8 fields r, g, b; fields of other kinds are ignored. For a
    cloud of one row ``row_step`` has no meaning and is ignored; bytes after the last point are ignored too.

    Raises:
        CloudError: x, y or z is missing, has the wrong type or lies outside the point; the steps contradict each other;
            ``data`` is too short.
    """
    table = _unique(fields)
    axes = _coordinate_fields(table)
    if width == 0 or height == 0:
        return DecodedCloud(np.zeros((0, 3), np.float32), None)
    for field in axes:
        _check_inside(field, point_step)
    buffer = _as_bytes(data)
    if height == 1:
        row_step = width * point_step
    _check_extent(width, height, point_step, row_step, len(buffer))
    order, size, steps = ">" if is_bigendian else "<", (height, width), (row_step, point_step)
    points = _view_of_coordinates(buffer, axes, order, size, steps)
    if points is None:
        formats = [f"{order}f{_size(f)}" for f in axes]
        records = _records(buffer, list(_AXES), formats, [f.offset for f in axes], size, steps)
        points = np.empty((*size, 3), np.float64 if any(_size(f) == 8 for f in axes) else np.float32)
        for column, axis in enumerate(_AXES):
            points[..., column] = records[axis]
    names, formats, offsets = _colour_layout(table, order, point_step)
    colors = _read_colors(_records(buffer, names, formats, offsets, size, steps), names) if names else None
    return DecodedCloud(points.reshape(-1, 3), colors)


def encode_cloud(points: npt.ArrayLike, colors: npt.ArrayLike | None = None) -> EncodedCloud:
    """Fields, point step and bytes of a PointCloud2 with float32 x, y, z and, with colours, a packed float32 ``rgb``.

    Args:
        points: (N, 3) [m].
        colors: (N, 3) uint8 or None.

    Raises:
        CloudError: an array has the wrong shape, or the colours are not uint8.
    """
    xyz = np.asarray(points)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind not in "fiu":
        raise CloudError(f"points must be numbers of shape (N, 3), got {xyz.dtype} of shape {xyz.shape}")
    fields = tuple(Field(name, 4 * i, FLOAT32) for i, name in enumerate(_AXES))
    if colors is None:
        return EncodedCloud(fields, 12, np.ascontiguousarray(xyz, "<f4").tobytes())
    rgb = np.asarray(colors)
    if rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise CloudError(f"colors must be uint8 of shape {xyz.shape}, got {rgb.dtype} of shape {rgb.shape}")
    table = np.empty((len(xyz), 4), "<f4")
    table[:, :3] = xyz
    channel = rgb.astype(np.uint32)
    table.view("<u4")[:, 3] = 0xFF000000 | channel[:, 0] << 16 | channel[:, 1] << 8 | channel[:, 2]
    return EncodedCloud((*fields, Field("rgb", 12, FLOAT32)), 16, table.tobytes())


def _unique(fields: Iterable[FieldLike]) -> dict[str, FieldLike]:
    table: dict[str, FieldLike] = {}
    for field in fields:
        if field.name in table:
            raise CloudError(f"the cloud has two fields named '{field.name}'; names must be unique")
        table[field.name] = field
    return table


def _coordinate_fields(table: dict[str, FieldLike]) -> list[FieldLike]:
    missing = [axis for axis in _AXES if axis not in table]
    if missing:
        has = ", ".join(table) or "none"
        raise CloudError(f"the cloud lacks the field(s) {', '.join(missing)}; its fields are: {has}")
    for axis in _AXES:
        field = table[axis]
        if field.datatype not in (FLOAT32, FLOAT64):
            raise CloudError(f"field '{axis}' must be FLOAT32 (7) or FLOAT64 (8), got {_type_name(field.datatype)}")
        if field.count not in (0, 1):  # some drivers leave the count of a scalar at 0
            raise CloudError(f"field '{axis}' must have count 1, got {field.count}")
    return [table[axis] for axis in _AXES]


def _check_inside(field: FieldLike, point_step: int) -> None:
    end = field.offset + _size(field)
    if field.offset < 0 or end > point_step:
        raise CloudError(
            f"field '{field.name}' covers bytes {field.offset} to {end} of a point, but point_step is {point_step}"
        )


def _check_extent(width: int, height: int, point_step: int, row_step: int, size: int) -> None:
    if width < 0 or height < 0:
        raise CloudError(f"width and height must not be negative, got {width} x {height}")
    if row_step < width * point_step:
        raise CloudError(
            f"row_step is {row_step} bytes, but {width} points of {point_step} bytes need at least {width * point_step}"
        )
    needed = (height - 1) * row_step + width * point_step
    if size < needed:
        raise CloudError(
            f"data is truncated: {width} x {height} points with point_step {point_step} and row_step {row_step} need "
            f"{needed} bytes, got {size}"
        )


def _view_of_coordinates(
    buffer: npt.NDArray[np.uint8], axes: list[FieldLike], order: str, size: tuple[int, int], steps: tuple[int, int]
) -> npt.NDArray[np.floating[Any]] | None:
    """(height, width, 3): what the buffer holds, where x, y, z lie in a row as this machine's numbers do."""
    each, first = _size(axes[0]), axes[0].offset
    kind = np.dtype(f"{order}f{each}")
    if not kind.isnative or any((_size(f), f.offset) != (each, first + i * each) for i, f in enumerate(axes)):
        return None
    view: npt.NDArray[np.floating[Any]] = np.ndarray((*size, 3), kind, buffer, first, (*steps, each))
    view.flags.writeable = False
    return view if view.flags.aligned else None


def _records(
    buffer: npt.NDArray[np.uint8],
    names: list[str],
    formats: list[str],
    offsets: list[int],
    size: tuple[int, int],
    steps: tuple[int, int],
) -> npt.NDArray[np.void]:
    """(height, width) of records that have these fields."""
    record = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": steps[1]})
    return np.ndarray(size, record, buffer, strides=steps)


def _colour_layout(table: dict[str, FieldLike], order: str, point_step: int) -> tuple[list[str], list[str], list[int]]:
    """Names, numpy formats and offsets of what holds the colours; empty lists when there are none to read."""
    for name in _PACKED:
        field = table.get(name)
        if field is not None and field.datatype in (FLOAT32, UINT32, INT32) and field.count in (0, 1):
            _check_inside(field, point_step)
            return [name], [f"{order}u4"], [field.offset]
    for names in _CHANNELS:
        channels = [table[name] for name in names if name in table and table[name].datatype == UINT8]
        if len(channels) == 3:
            for field in channels:
                _check_inside(field, point_step)
            return list(names), ["u1"] * 3, [f.offset for f in channels]
    return [], [], []


def _read_colors(records: npt.NDArray[np.void], names: list[str]) -> Colors:
    colors = np.empty((*records.shape, 3), np.uint8)
    if len(names) == 1:
        packed = records[names[0]].astype(np.uint32)
        channels = [packed >> shift & 0xFF for shift in (16, 8, 0)]
    else:
        channels = [records[name] for name in names]
    for column, channel in enumerate(channels):
        colors[..., column] = channel
    return colors.reshape(-1, 3)


def _as_bytes(data: Any) -> npt.NDArray[np.uint8]:
    try:
        return np.frombuffer(data, np.uint8) if len(data) else np.zeros(0, np.uint8)
    except (TypeError, ValueError, BufferError):
        pass
    try:
        return np.ascontiguousarray(data, np.uint8).reshape(-1)
    except (TypeError, ValueError, OverflowError) as error:
        raise CloudError(f"data must be a buffer of bytes, got {type(data).__name__}") from error


def _size(field: FieldLike) -> int:
    return _SIZES[field.datatype - 1]


def _type_name(datatype: int) -> str:
    known = 1 <= datatype <= len(_NAMES)
    return f"{_NAMES[datatype - 1]} ({datatype})" if known else f"the unknown datatype {datatype}"
