"""An object as bytes: its mesh, its convex parts and what it is made of, in one safetensors file.

Nothing in such a file is executed when it is read, and the same object always gives the same bytes.

    vertices         (V, 3) float64 [m]        part_vertices   (sum of Vi, 3) float64 [m]
    faces            (F, 3) int32              part_faces      (sum of Fi, 3) int32, counted within their part
    part_offsets     (P + 1, 2) int32: where the vertices and the faces of each part start, and where the last ends

and in the metadata, under the key "object", a JSON text with `schema`, `has_parts` and the other fields of ObjectModel.
"""

import json
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from safetensors import SafetensorError, deserialize
from safetensors.numpy import save

from regnet_core.data.objects.models import ObjectModel
from regnet_core.errors import InvalidInputError

SCHEMA = "regnet_object/1"
_KEY = "object"
_DTYPES = {"F64": np.float64, "I32": np.int32}
_COLUMNS = {"vertices": 3, "faces": 3, "part_vertices": 3, "part_faces": 3, "part_offsets": 2}


def object_to_bytes(model: ObjectModel) -> bytes:
    """The object as a safetensors file; its convex parts go along where `model.parts` holds them."""
    parts = model.parts or ()
    counts = np.array([(len(part.vertices), len(part.faces)) for part in parts]).reshape(-1, 2)
    tensors: dict[str, NDArray[Any]] = {
        "vertices": np.ascontiguousarray(model.mesh.vertices, dtype=np.float64),
        "faces": np.ascontiguousarray(model.mesh.faces, dtype=np.int32),
        "part_vertices": _stacked([part.vertices for part in parts], np.float64),
        "part_faces": _stacked([part.faces for part in parts], np.int32),
        "part_offsets": np.concatenate([np.zeros((1, 2)), np.cumsum(counts, axis=0)]).astype(np.int32),
    }
    description = {
        "schema": SCHEMA,
        "name": model.name,
        "family": model.family,
        "params": dict(model.params),
        "colour": list(model.colour),
        "density": model.density,
        "friction": model.friction,
        "has_parts": model.parts is not None,
    }
    return save(tensors, metadata={_KEY: json.dumps(description)})


def object_from_bytes(data: bytes) -> ObjectModel:
    """Reads what `object_to_bytes` wrote; vertices and faces are exactly the same.

    Raises:
        InvalidInputError: the bytes are damaged, or of another kind or schema.
    """
    tensors, description = _tensors(data), _description(data)
    try:
        red, green, blue = (int(channel) for channel in description["colour"])
        return ObjectModel(
            name=str(description["name"]),
            family=str(description["family"]),
            params={str(key): float(value) for key, value in description["params"].items()},
            mesh=_mesh(tensors["vertices"], tensors["faces"]),
            colour=(red, green, blue),
            density=float(description["density"]),
            friction=float(description["friction"]),
            parts=_parts(tensors) if description["has_parts"] else None,
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InvalidInputError(f"an object file is damaged: {error!r}; write it again with object_to_bytes") from error


def _stacked(arrays: Sequence[Any], dtype: type) -> NDArray[Any]:
    """Arrays (N, 3) one under another; (0, 3) of none."""
    return np.concatenate([np.zeros((0, 3), dtype), *(np.asarray(array, dtype=dtype) for array in arrays)])


def _tensors(data: bytes) -> dict[str, NDArray[Any]]:
    try:
        entries = dict(deserialize(data))
    except SafetensorError as error:
        raise InvalidInputError(
            f"these {len(data)} bytes are no safetensors file, or it is damaged: {error}"
        ) from error
    if set(entries) != set(_COLUMNS):
        raise InvalidInputError(f"an object file holds {sorted(_COLUMNS)}, got {sorted(entries)}")
    tensors = {}
    for name, entry in entries.items():
        columns, expected = _COLUMNS[name], "F64" if "vertices" in name else "I32"
        if entry["dtype"] != expected or entry["shape"][1:] != [columns]:
            raise InvalidInputError(
                f"{name} of an object file is (N, {columns}) {expected}, got {entry['shape']} {entry['dtype']}"
            )
        tensors[name] = np.frombuffer(entry["data"], _DTYPES[expected]).reshape(-1, columns).copy()
    return tensors


def _description(data: bytes) -> dict[str, Any]:
    """The JSON text of a file whose tensors are known to be readable: the header is its length, then JSON."""
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    text = header.get("__metadata__", {}).get(_KEY)
    try:
        description = json.loads(text)
        schema = description["schema"]
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidInputError(f"an object file's metadata say {_KEY!r} as JSON, got {text!r:.80}") from error
    if schema != SCHEMA:
        raise InvalidInputError(f"this version reads object files of schema {SCHEMA!r}, got {schema!r}")
    return description


def _parts(tensors: dict[str, NDArray[Any]]) -> tuple[trimesh.Trimesh, ...]:
    offsets, vertices, faces = tensors["part_offsets"], tensors["part_vertices"], tensors["part_faces"]
    ends = [[0, 0], [len(vertices), len(faces)]]
    if len(offsets) == 0 or offsets[[0, -1]].tolist() != ends or np.any(np.diff(offsets, axis=0) < 1):
        raise InvalidInputError(
            f"part_offsets of an object file rise from {ends[0]} to {ends[1]}, got {offsets.tolist()}"
        )
    bounds = pairwise(offsets.tolist())
    return tuple(_mesh(vertices[v0:v1], faces[f0:f1]) for (v0, f0), (v1, f1) in bounds)


def _mesh(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> trimesh.Trimesh:
    if not np.all(np.isfinite(vertices)) or len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise InvalidInputError(
            f"a mesh of an object file has finite vertices and faces that name them, got {len(vertices)} vertices and "
            f"{len(faces)} faces, from {faces.min(initial=0)} to {faces.max(initial=0)}"
        )
    return trimesh.Trimesh(vertices, faces, process=False)
