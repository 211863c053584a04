"""Pictures of a data set's scenes: what a camera saw, the point confidence of a width, and the best grasps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from regnet_core.data.storage.archive import SceneArchive, view_points
from regnet_core.geometry import Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.view.scene import ViewScene

_STOPS = np.array([[0.68, 0.70, 0.74], [0.98, 0.83, 0.30], [0.95, 0.45, 0.14], [0.75, 0.06, 0.18]])
"""Colours of confidence 0, 1/3, 2/3 and 1."""


def confidence_colours(confidence: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """(N, 3) red, green, blue: grey for 0, over yellow, to red for 1."""
    at = np.linspace(0.0, 1.0, len(_STOPS))
    return np.stack([np.interp(confidence, at, _STOPS[:, c]) * 255.0 for c in range(3)], axis=1).astype(np.uint8)


def label_scenes(archive: SceneArchive, index: int, view: int, widths: Sequence[float]) -> list[ViewScene]:
    """For each width two panels of one view: its cloud in true colours with the best grasps, and its confidence.

    Raises:
        InvalidInputError: no such scene.
    """
    info, data, labels = archive.info(index), archive.view(index, view), archive.labels(index)
    rows, columns = np.nonzero(np.isfinite(data.depth))
    points = view_points(info.views[view], data, rows, columns)
    plane = Plane((0.0, 0.0, 1.0), info.table.upper[2])
    x, y, z = info.views[view].camera.position.tolist()
    scenes = []
    for width in widths:
        w = archive.widths.index(width)
        own, gripper = labels[w], Gripper(width=width)
        grasps = own.grasps(width)[np.argsort(-own.score, kind="stable")]
        what = f"scene {index} ({info.kind}), {info.views[view].sensor}"
        title = f"{what}: {1000 * width:.0f} mm"
        caption = f"best of {len(own)} stored of {info.found[w]} grasps"
        confidence = data.confidence[w][rows, columns]
        best = f"point confidence, up to {confidence.max(initial=0.0):.2f}"
        true_colours, shown = data.colours[rows, columns], confidence_colours(confidence)
        scenes.append(ViewScene(points, true_colours, grasps, gripper, None, plane, title, caption, (x, y, z)))
        scenes.append(ViewScene(points, shown, Grasps.empty(), gripper, None, plane, title, best, (x, y, z)))
    return scenes
