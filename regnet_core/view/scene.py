"""What a picture shows: one cloud with the grasps of one gripper."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.detector import Detection
from regnet_core.geometry import Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper


@dataclass(frozen=True)
class ViewScene:
    """One detection as it is to be drawn; everything is in one gravity-aligned frame [m]."""

    points: npt.NDArray[np.floating[Any]]
    """(N, 3); invalid points are allowed and not drawn."""
    colors: npt.NDArray[np.uint8] | None
    """(N, 3) in 0..255; None colours the cloud by height."""
    grasps: Grasps
    """Best first."""
    gripper: Gripper
    selected: int | None = None
    """Rank of the selected grasp."""
    plane: Plane | None = None
    title: str = ""
    caption: str = ""
    """One line below the title: numbers, or why there is no grasp."""
    viewpoint: tuple[float, float, float] | None = None
    """Where the camera was; the picture is then taken from that side."""

    @classmethod
    def of_detection(
        cls,
        detection: Detection,
        points: npt.ArrayLike,
        colors: npt.NDArray[np.uint8] | None = None,
        *,
        selected: int | None = None,
        title: str = "",
        caption: str = "",
        viewpoint: tuple[float, float, float] | None = None,
    ) -> ViewScene:
        """The scene of a detection and of the cloud (N, 3) it was made from."""
        return cls(
            np.asarray(points),
            colors,
            detection.grasps,
            detection.gripper,
            selected,
            detection.plane,
            title or f"gripper width {1000 * detection.gripper.width:.0f} mm",
            caption or detection.report.reason or f"{len(detection.grasps)} grasps",
            viewpoint,
        )

    def without_invalid(self) -> ViewScene:
        """The same scene without the points that are NaN or infinite."""
        ok = np.isfinite(self.points).all(axis=1)
        if ok.all():
            return self
        return self.with_points(np.flatnonzero(ok))

    def with_points(self, index: npt.NDArray[np.int64]) -> ViewScene:
        """The same scene with only these rows of the cloud."""
        return replace(self, points=self.points[index], colors=None if self.colors is None else self.colors[index])

    def object_points(self) -> npt.NDArray[np.floating[Any]]:
        """The points (K, 3) above the support plane, the flying ones left out; all points when there are hardly any."""
        if self.plane is None or len(self.points) == 0:
            return self.points
        height = self.plane.height(self.points)
        above = self.points[(height > 0.012) & (height < 0.6)]
        return above if len(above) >= 30 else self.points


def spread_out(grasps: Grasps, gripper: Gripper, count: int, distance: float = 0.035) -> npt.NDArray[np.int64]:
    """Ranks of at most ``count`` grasps, best first, whose fingertips are ``distance`` [m] apart from each other.

    The best grasps of a detection crowd around a few spots; a picture of all of them shows none.
    """
    tips = grasps.fingertips(gripper)
    chosen: list[int] = []
    for rank in range(len(grasps)):
        if len(chosen) == count:
            break
        if not chosen or np.linalg.norm(tips[chosen] - tips[rank], axis=1).min() >= distance:
            chosen.append(rank)
    return np.asarray(chosen, dtype=np.int64)


def thinned(count: int, limit: int) -> npt.NDArray[np.int64]:
    """At most ``limit`` of ``count`` rows, evenly taken; the same ones at every call."""
    if count <= limit:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, limit, replace=False))
