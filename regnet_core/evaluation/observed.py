"""What all methods get to see of a scene, and are checked against: one camera's cloud, cropped and thinned.

It is cropped as a user crops to the workspace, to the box around whatever is not the table, AROUND larger on its
sides. Of what is left ``points`` are drawn at random; fewer stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from regnet_core.checks import check_range
from regnet_core.data.cameras.rendering import TABLE_ID
from regnet_core.data.storage.archive import SceneArchive, view_points
from regnet_core.geometry import Array, Plane

POINTS = 25600
"""N of the paper."""
AROUND = 0.10
"""The crop is larger than the box around what is not the table by so much on each side [m]."""


@dataclass(frozen=True, eq=False)
class ObservedCloud:
    """One view of a scene, in the world frame."""

    points: Array
    """(N, 3) [m]."""
    viewpoint: Array
    """(3,) the camera's position [m]."""
    plane: Plane
    """The true top of the table."""


class CloudSource(Protocol):
    """Where the clouds of a study come from; it goes to other processes."""

    def __call__(self, archive: SceneArchive, scene: int, view: int) -> ObservedCloud:
        """What camera ``view`` saw of the scene; the same at each call."""
        ...

    def seeded(self, seed: int) -> CloudSource:
        """The same views, with another seed of what is random in them."""
        ...

    def settings(self) -> dict[str, Any]:
        """What the clouds depend on, as JSON has it."""
        ...


@dataclass(frozen=True)
class RecordedViews:
    """The views of the data set.

    Raises:
        InvalidInputError: a number is out of range.
    """

    points: int = POINTS
    """Most points of a cloud."""
    seed: int = 0
    """Of the points that are drawn; the scene and the view decide the rest."""

    def __post_init__(self) -> None:
        check_range("points", self.points, 1, 10_000_000)
        check_range("seed", self.seed, 0, 2**31 - 1)

    def __call__(self, archive: SceneArchive, scene: int, view: int) -> ObservedCloud:
        """What camera ``view`` of the scene saw.

        Raises:
            InvalidInputError: there is no such scene, or its files are damaged.
        """
        info, data = archive.info(scene), archive.view(scene, view)
        seen = info.views[view]
        rows, columns = np.nonzero(np.isfinite(data.depth))
        points = view_points(seen, data, rows, columns).astype(np.float64)
        rng = np.random.default_rng([self.seed, scene, view])
        chosen = cropped_and_drawn(points, data.object_index[rows, columns] != TABLE_ID, self.points, rng)
        return ObservedCloud(
            points[chosen], seen.camera.position.copy(), Plane((0.0, 0.0, 1.0), float(info.table.upper[2]))
        )

    def seeded(self, seed: int) -> RecordedViews:
        return replace(self, seed=seed)

    def settings(self) -> dict[str, Any]:
        return {"clouds": "views of the data set", "points": self.points, "seed": self.seed}


def cropped_and_drawn(
    points: Array, foreground: npt.NDArray[np.bool_], count: int, rng: np.random.Generator
) -> npt.NDArray[np.int64]:
    """Rows, rising, of at most ``count`` of the points (N, 3) [m] that are in the box around the foreground (N,).

    The box has all heights; without a foreground it has everything.
    """
    rows = np.arange(len(points))
    if foreground.any():
        lower = points[foreground, :2].min(axis=0) - AROUND
        upper = points[foreground, :2].max(axis=0) + AROUND
        rows = np.flatnonzero(((points[:, :2] >= lower) & (points[:, :2] <= upper)).all(axis=1))
    return rows if len(rows) <= count else np.sort(rng.choice(rows, count, replace=False))
