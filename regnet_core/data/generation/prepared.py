"""Objects made ready for scenes: mesh, convex parts, triangle tree, and the grasps of each gripper width."""

from __future__ import annotations

import zlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from regnet_core.data.generation.settings import GenerationSettings
from regnet_core.data.labels.candidates import Candidates, object_candidates
from regnet_core.data.labels.scene_labels import rotation_from_quaternion
from regnet_core.data.objects.files import object_from_bytes
from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.storage.compact import pack, unpack
from regnet_core.geometry import Array
from regnet_core.ops.triangle_tree import TriangleTree, build_tree

_FIELDS = ("point", "quaternion", "translation", "high", "low", "score", "entry")
_CACHED = 400
"""Prepared objects that a process keeps in memory."""


@dataclass(frozen=True, eq=False)
class PreparedObject:
    """An object with its own grasps.

    Attributes:
        model: mesh, mass, friction, convex parts.
        candidates: for each width of the data set.
    """

    model: ObjectModel
    candidates: tuple[Candidates, ...]

    @cached_property
    def tree(self) -> TriangleTree:
        """Over the mesh's triangles."""
        return build_tree(self.model.mesh.vertices, self.model.mesh.faces)

    @cached_property
    def area(self) -> float:
        """Of the surface [m^2]."""
        return float(self.model.mesh.area)


def candidates_to_bytes(model: ObjectModel, settings: GenerationSettings) -> bytes:
    """Samples an object's grasps for every width; the name and the settings decide every random number."""
    rng = np.random.default_rng([settings.seed, zlib.crc32(model.name.encode())])
    arrays: dict[str, npt.NDArray[Any]] = {}
    for w, one in enumerate(object_candidates(model.mesh, settings.grippers, rng, settings.candidates)):
        quaternion = Rotation.from_matrix(one.rotation).as_quat() if len(one) else np.zeros((0, 4))
        values = (one.point.astype(np.uint16), quaternion, one.translation, one.high, one.low, one.score, one.entry)
        for name, value in zip(_FIELDS, values, strict=True):
            arrays[f"{w}.{name}"] = value if value.dtype == np.uint16 else value.astype(np.float32)
    return pack(arrays)


def candidates_from_bytes(data: bytes, widths: int, what: str) -> tuple[Candidates, ...]:
    """Reads what ``candidates_to_bytes`` wrote.

    Raises:
        InvalidInputError: it is damaged.
    """
    arrays = unpack(data, what)

    def read(w: int) -> Candidates:
        point, quaternion, *rest = (arrays[f"{w}.{name}"] for name in _FIELDS)
        translation, high, low, score, entry = rest
        # Single precision, as stored: a process may keep hundreds of objects.
        rotation = rotation_from_quaternion(quaternion.astype(np.float64)).astype(np.float32)
        return Candidates(point.astype(np.int32), rotation, translation, high, low, score, entry)

    return tuple(read(w) for w in range(widths))


class ObjectSource(Protocol):
    """Where the files of a data set's objects come from."""

    def read(self, name: str) -> tuple[bytes, bytes]:
        """The object's file and its candidates' file."""
        ...


@dataclass(frozen=True)
class FolderSource:
    """The folders ``objects`` and ``candidates`` of a data set."""

    root: Path

    def object_path(self, name: str) -> Path:
        return self.root / "objects" / f"{name}.safetensors"

    def candidates_path(self, name: str) -> Path:
        return self.root / "candidates" / f"{name}.st.zst"

    def read(self, name: str) -> tuple[bytes, bytes]:
        return self.object_path(name).read_bytes(), self.candidates_path(name).read_bytes()


@dataclass(frozen=True, eq=False)
class MemorySource:
    """The same files as arrays of bytes, which a cluster's nodes share without copying them for every process."""

    files: Mapping[str, tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]]

    @classmethod
    def of(cls, source: ObjectSource, names: Sequence[str]) -> MemorySource:
        """All of these objects' files."""
        read = {name: source.read(name) for name in names}
        return cls({name: (np.frombuffer(a, np.uint8), np.frombuffer(b, np.uint8)) for name, (a, b) in read.items()})

    def read(self, name: str) -> tuple[bytes, bytes]:
        first, second = self.files[name]
        return first.tobytes(), second.tobytes()


class PreparedLibrary:
    """Prepared objects by name; the last ones used stay in memory."""

    def __init__(self, source: ObjectSource, widths: int) -> None:
        self._source = source
        self._widths = widths
        self._cache: OrderedDict[str, PreparedObject] = OrderedDict()

    def __getitem__(self, name: str) -> PreparedObject:
        if name not in self._cache:
            model, candidates = self._source.read(name)
            self._cache[name] = PreparedObject(
                object_from_bytes(model), candidates_from_bytes(candidates, self._widths, f"the candidates of {name}")
            )
            if len(self._cache) > _CACHED:
                self._cache.popitem(last=False)
        self._cache.move_to_end(name)
        return self._cache[name]


def areas(objects: Sequence[PreparedObject]) -> Array:
    """(K,) surfaces [m^2]."""
    return np.array([one.area for one in objects])
