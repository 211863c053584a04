"""Reads a data set: any scene, view or label, without unpacking an archive."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from regnet_core.data.generation.prepared import FolderSource
from regnet_core.data.labels.scene_labels import GraspLabels
from regnet_core.data.objects.files import object_from_bytes
from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.scenes.scene import Scene
from regnet_core.data.storage.manifest import Manifest
from regnet_core.data.storage.records import (
    SceneInfo,
    ViewData,
    ViewInfo,
    info_from_bytes,
    labels_from_bytes,
    scene_key,
    view_from_bytes,
)
from regnet_core.data.storage.tars import Extent, index_tar, shard_paths
from regnet_core.errors import InvalidInputError


class SceneArchive:
    """The scenes of a data set, numbered from 0.

    Files are opened for each read, so it may go to other processes, and archives may be many.
    """

    def __init__(self, folder: Path | str) -> None:
        """Args: the folder of the data set, finished or still growing; only whole shards are read.

        Raises:
            InvalidInputError: it is no data set, or an archive is damaged.
        """
        self.folder = Path(folder)
        self.manifest = Manifest.load(self.folder)
        self._extents: dict[str, tuple[Path, Extent]] = {}
        for path in shard_paths(self.folder):
            self._extents.update({name: (path, extent) for name, extent in index_tar(path).items()})
        keys = (name.removesuffix(".json") for name in self._extents if name.endswith(".json"))
        self.indices: tuple[int, ...] = tuple(sorted(int(key) for key in keys))
        """Numbers of the scenes that are there."""

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[int]:
        return iter(self.indices)

    @property
    def widths(self) -> tuple[float, ...]:
        """Gripper widths of the labels [m]."""
        return self.manifest.settings.widths

    def info(self, index: int) -> SceneInfo:
        """Objects, poses and cameras of a scene."""
        name = f"{scene_key(index)}.json"
        return info_from_bytes(self._read(name), name)

    def labels(self, index: int) -> list[GraspLabels]:
        """The stored grasps of a scene, for each of ``widths``."""
        name = f"{scene_key(index)}.grasps.st.zst"
        return labels_from_bytes(self._read(name), name)

    def view(self, index: int, number: int) -> ViewData:
        """What camera ``number`` of a scene saw."""
        name = f"{scene_key(index)}.view{number}.st.zst"
        return view_from_bytes(self._read(name), name)

    def scene(self, index: int) -> Scene:
        """The true scene, with the objects' meshes, as the simulator and the judge of grasps take it."""
        info = self.info(index)
        return Scene(tuple(self.model(name) for name in info.objects), info.poses, info.table, info.fixtures)

    def model(self, name: str) -> ObjectModel:
        """An object of the data set's library."""
        return _load_model(FolderSource(self.folder).object_path(name))

    def _read(self, name: str) -> bytes:
        if name not in self._extents:
            raise InvalidInputError(f"'{self.folder}' has no {name}; its scenes are {_ranges(self.indices)}")
        path, extent = self._extents[name]
        with open(path, "rb") as file:
            file.seek(extent.offset)
            return file.read(extent.size)


@lru_cache(maxsize=512)
def _load_model(path: Path) -> ObjectModel:
    return object_from_bytes(path.read_bytes())


def view_points(
    info: ViewInfo, data: ViewData, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """World points (N, 3) of pixels of a view, by row and column in ``data`` [m]; NaN where there is no return."""
    k = info.camera.intrinsics
    depth = data.depth[rows, columns]
    x = (columns + info.origin[1] - np.float32(k.cx)).astype(np.float32) * (depth / np.float32(k.fx))
    y = (rows + info.origin[0] - np.float32(k.cy)).astype(np.float32) * (depth / np.float32(k.fy))
    T = info.camera.T_world_camera.astype(np.float32)
    return np.stack([x, y, depth], axis=1) @ T[:3, :3].T + T[:3, 3]


def _ranges(indices: tuple[int, ...]) -> str:
    return f"{indices[0]} to {indices[-1]}" if indices else "none yet"
