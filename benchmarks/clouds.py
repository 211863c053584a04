"""The clouds that are measured on: from bags or files, or a made-up one, in the frame of the camera."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array
from regnet_core.io.bags import cloud_topics, is_bag, read_bag_clouds
from regnet_core.io.files import check_cloud_file, read_cloud_file
from regnet_core.io.pointcloud2 import Colors

MADE_UP = "made-up"
_MADE_UP_POINTS = 60_000
"""After thinning more than the 25600 points of the paper are left."""
_FEWEST = 100


class CloudSource(NamedTuple):
    """Where a cloud comes from."""

    path: Path | None
    """A bag or file; None for a made-up cloud."""
    number: int
    """Which cloud of a bag, counted from 0; how many points of a made-up cloud."""

    @property
    def text(self) -> str:
        """What ``cloud_source`` makes the same of, wherever it is called."""
        if self.path is None:
            return f"{MADE_UP}:{self.number}"
        return f"{self.path}:{self.number}" if is_bag(self.path) else str(self.path)

    @property
    def name(self) -> str:
        """For tables: no path."""
        if self.path is None:
            return f"{MADE_UP} {self.number}"
        return f"{self.path.name} {self.number}" if is_bag(self.path) else self.path.name


@dataclass(frozen=True)
class GivenCloud:
    """One cloud."""

    name: str
    """Of the bag or file, and the number of the message."""
    points: npt.NDArray[np.floating]
    """(N, 3), invalid ones included [m]."""
    colors: Colors | None
    T_target_cloud: Array
    """(4, 4): the camera's pose in a gravity-aligned frame."""


def cloud_source(text: str) -> CloudSource:
    """Where the cloud is that a user means.

    Args:
        text: a bag's folder or file, with ``:K`` for its K-th cloud (the first, 0, when not given); a cloud file in a
            gravity-aligned frame; or ``made-up:N``, a table with boxes in N points, the same at every call.

    Raises:
        InvalidInputError: there is no such file, or no such number.
    """
    name, _, number = text.rpartition(":")
    if name == "" or not number.isdigit():
        name, number = text, ""
    if name == MADE_UP:
        return CloudSource(None, int(number or _MADE_UP_POINTS))
    path = Path(name).resolve()
    if not is_bag(path):
        check_cloud_file(path)
        if number:
            raise InvalidInputError(f"only bags have more than one cloud: '{text}' names cloud {number} of a file")
    return CloudSource(path, int(number or 0))


def read_cloud(text: str) -> GivenCloud:
    """The cloud that a user means, see ``cloud_source``.

    Raises:
        InvalidInputError: there is no such cloud.
    """
    source = cloud_source(text)
    if source.path is None:
        return GivenCloud(source.name, made_up_cloud(source.number), None, np.eye(4))
    if not is_bag(source.path):
        found = read_cloud_file(source.path)
        return GivenCloud(source.name, found.points, found.colors, np.eye(4))
    cloud = next(islice(read_bag_clouds(source.path, bag_topic(source.path)), source.number, None), None)
    if cloud is None:
        raise InvalidInputError(
            f"the bag '{source.path.name}' has no cloud {source.number}; its clouds are counted from 0"
        )
    pose = np.eye(4) if cloud.T_root_cloud is None else cloud.T_root_cloud
    return GivenCloud(source.name, cloud.points, cloud.colors, pose)


def bag_topic(bag: Path) -> str:
    """The topic of a bag's clouds, the one with most of them.

    Raises:
        InvalidInputError: it has none.
    """
    counts = cloud_topics(bag)
    if not any(counts.values()):
        raise InvalidInputError(f"the bag '{bag.name}' has no point clouds")
    return max(counts, key=lambda topic: counts[topic])


def made_up_cloud(count: int, seed: int = 0) -> npt.NDArray[np.float32]:
    """(count, 3): a table-top of 0.5 m with boxes on it, seen from above, with a camera's noise [m].

    Raises:
        InvalidInputError: the count is less than 100.
    """
    if count < _FEWEST:
        raise InvalidInputError(f"a made-up cloud needs at least {_FEWEST} points, got {count}")
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-0.25, 0.25, (count, 2))
    z = np.zeros(count)
    for _ in range(8):
        centre, half = rng.uniform(-0.17, 0.17, 2), rng.uniform(0.015, 0.03, 2)
        height = rng.uniform(0.03, 0.12)
        z = np.where((np.abs(xy - centre) < half).all(axis=1), np.maximum(z, height), z)
    cloud = np.column_stack([xy, z + 0.7]) + rng.normal(0.0, 0.0007, (count, 3))
    return cloud.astype(np.float32)
