"""Point clouds from files: .pcd, .ply, .npy and .npz. Nothing is ever unpickled."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.errors import CloudError
from regnet_core.io.pointcloud2 import Colors

Points = npt.NDArray[np.floating[Any]]


class CloudFile(NamedTuple):
    """The points of a file, in the file's own frame and order; invalid (NaN) points are kept."""

    points: Points
    """(N, 3) [m], float32 or float64 as in the file."""
    colors: Colors | None
    """(N, 3) red, green, blue in 0..255; None when the file has none."""


def read_cloud_file(path: str | Path) -> CloudFile:
    """Read a point cloud; the suffix says what kind of file it is.

    - .pcd: ascii, binary or binary_compressed, with fields x, y, z and optionally rgb or rgba;
    - .ply: ascii or binary; the vertices, with red, green, blue if they have them;
    - .npy: an array (N, 3), or (N, 6) with red, green, blue in 0..255, or in 0..1 where none is larger;
    - .npz: ``points`` (N, 3) and optionally ``colors`` (N, 3), uint8, or as above.

    Raises:
        CloudError: there is no such file, its suffix is unknown, or it does not hold a point cloud.
    """
    file = Path(path)
    check_cloud_file(file)
    try:
        return _READERS[file.suffix.lower()](file)
    except CloudError as error:
        raise CloudError(f"'{file}': {error}") from error
    except Exception as error:  # the libraries raise whatever a corrupt file makes them stumble over
        raise CloudError(f"'{file}' cannot be read as {file.suffix}: {_in_one_line(error)}") from error


def check_cloud_file(file: Path) -> None:
    """Refuse what cannot be read as a point cloud, as far as that is seen without reading it.

    Raises:
        CloudError: there is no such file, or its suffix is unknown.
    """
    if file.suffix.lower() not in _READERS:
        known = ", ".join(_READERS)
        raise CloudError(f"'{file.name}' has an unknown suffix '{file.suffix}'; point clouds are read from {known}")
    if not file.is_file():
        raise CloudError(f"there is no file '{file}'")


def _read_pcd(file: Path) -> CloudFile:
    from pypcd4 import PointCloud

    cloud = PointCloud.from_path(file)
    records, expected = cloud.pc_data, cloud.metadata.points
    if len(records) != expected:
        raise CloudError(f"the file is truncated: its header promises {expected} points, it holds {len(records)}")
    names = records.dtype.names or ()
    _require_axes(names)
    points = _stack([records[axis] for axis in "xyz"])
    packed = next((records[name] for name in ("rgb", "rgba") if name in names), None)
    if packed is None or packed.dtype.itemsize != 4:
        return CloudFile(points, None)
    bits = np.ascontiguousarray(packed).view(np.uint32)
    return CloudFile(points, np.stack([bits >> shift & 0xFF for shift in (16, 8, 0)], axis=1).astype(np.uint8))


def _read_ply(file: Path) -> CloudFile:
    from trimesh.exchange.ply import load_ply

    with file.open("rb") as stream:
        declared = _vertex_properties(stream)
        if declared:
            _require_axes(declared)  # load_ply would only say 'x'
        stream.seek(0)
        content = load_ply(stream, fix_texture=False, skip_materials=True)
    vertex = content["metadata"]["_ply_raw"].get("vertex")
    if vertex is None:
        raise CloudError("the file has no element 'vertex'")
    names = tuple(vertex["properties"])
    if vertex["length"] == 0:
        return CloudFile(np.zeros((0, 3), np.float32), None)
    columns = [np.asarray(vertex["data"][axis]).reshape(-1) for axis in "xyz"]
    if len(columns[0]) != vertex["length"]:
        raise CloudError(f"the file is truncated: {vertex['length']} vertices promised, {len(columns[0])} found")
    channels = [name for name in ("red", "green", "blue") if name in names]
    colors = None
    if len(channels) == 3:
        colors = _as_colors(np.stack([np.asarray(vertex["data"][name]).reshape(-1) for name in channels], axis=1))
    return CloudFile(_stack(columns), colors)


def _vertex_properties(stream: BinaryIO) -> tuple[str, ...]:
    """The names of the vertices' properties in a .ply file's header."""
    names: list[str] = []
    element = ""
    for line in iter(lambda: stream.readline(4096), b""):
        words = line.decode("ascii", "replace").split()
        if words[:1] == ["end_header"]:
            break
        if words[:1] == ["element"] and len(words) > 1:
            element = words[1]
        elif words[:1] == ["property"] and element == "vertex":
            names.append(words[-1])
    return tuple(names)


def _read_npy(file: Path) -> CloudFile:
    array = np.load(file, allow_pickle=False)
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.shape[1] not in (3, 6):
        raise CloudError(f"the array must have shape (N, 3) or (N, 6), got {np.shape(array)}")
    return CloudFile(_as_points(array[:, :3]), _as_colors(array[:, 3:]) if array.shape[1] == 6 else None)


def _read_npz(file: Path) -> CloudFile:
    if not zipfile.is_zipfile(file):
        raise CloudError("the file is not an .npz archive")
    with np.load(file, allow_pickle=False) as archive:
        if "points" not in archive:
            held = ", ".join(archive.files) or "nothing"
            raise CloudError(f"the archive must hold an array 'points', it holds {held}")
        points = _as_points(archive["points"])
        colors = _as_colors(archive["colors"]) if "colors" in archive else None
    if colors is not None and len(colors) != len(points):
        raise CloudError(f"'colors' must have one row for each of the {len(points)} points, got {len(colors)}")
    return CloudFile(points, colors)


def _require_axes(names: tuple[str, ...]) -> None:
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise CloudError(f"the file lacks {', '.join(missing)}; it has: {', '.join(names) or 'nothing'}")


def _stack(columns: list[npt.NDArray[Any]]) -> Points:
    return _as_points(np.stack(columns, axis=1))


def _as_points(array: npt.NDArray[Any]) -> Points:
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise CloudError(f"points must be numbers of shape (N, 3), got {array.dtype} of shape {array.shape}")
    native = np.float32 if array.dtype.itemsize <= 4 and array.dtype.kind == "f" else np.float64
    return np.ascontiguousarray(array, dtype=native)


def _as_colors(array: npt.NDArray[Any]) -> Colors:
    """Colours (N, 3) in 0..255; floating-point ones are read as 0..1 where none is larger than 1."""
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise CloudError(f"colours must be numbers of shape (N, 3), got {array.dtype} of shape {array.shape}")
    if array.dtype == np.uint8:
        return np.ascontiguousarray(array)
    if array.dtype.kind == "f":
        array = np.nan_to_num(array)
        array = array * 255.0 if array.size and array.max() <= 1.0 else array
    return np.clip(np.rint(array), 0, 255).astype(np.uint8)


def _in_one_line(error: Exception) -> str:
    """What a library's error says; pydantic's, which the .pcd reader raises for a bad header, lists several defects."""
    if callable(defects := getattr(error, "errors", None)):
        return "; ".join(f"{' '.join(map(str, d['loc']))}: {d['msg']}" for d in defects())
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


_READERS: dict[str, Callable[[Path], CloudFile]] = {
    ".pcd": _read_pcd,
    ".ply": _read_ply,
    ".npy": _read_npy,
    ".npz": _read_npz,
}
SUFFIXES = tuple(_READERS)
"""The suffixes that ``read_cloud_file`` knows."""
