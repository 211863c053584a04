"""The images that Grasp Pose Detection classifies: what is in a hand's closing area, projected along the hand's axes.

ten Pas et al., "Grasp Pose Detection in Point Clouds", 2017, section "Grasp image": the area is divided into 60 x 60
cells as seen along each of the hand's three axes. A cell holds the average of the surface normals of its points, as
absolute values of their components, and the average height of its points; cells without points hold 0. The paper has
15 channels, three views of normals (3), heights (1), and heights of what is hidden behind (1). Without the hidden part
they are 12. With 3 channels there is one view, along Z, of the normals alone.

As in the published code, gaps are closed by the largest value of the 3 x 3 cells around each, and normals and heights
of each view are divided by their largest value. The code's running average of normals is a mean here, as in the paper.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnet_core.baselines.closing_area import ClosingAreas
from regnet_core.errors import InvalidInputError
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range

SIZE = 60
"""Cells along each side of an image."""
CHANNELS = (3, 12)
"""How many channels images can have."""
VIEWS = np.array([[0, 1, 2], [2, 1, 0], [2, 0, 1]])
"""Of each view, the hand's axes along the image's rows, along its columns, and into it."""
Images = npt.NDArray[np.float32]


def grasp_images(areas: ClosingAreas, channels: int) -> Images:
    """Images (G, channels, 60, 60) of closing areas, all values in [0, 1].

    With 12 channels, each view has the averaged |normal| along X, Y and Z of the hand, then the height: 1 minus the
    average depth into the image. Views are those along Z, along X (what the palm sees) and along Y (what a finger
    sees). With 3 channels there are the normals of the first view.

    Raises:
        InvalidInputError: there are no images of so many channels.
    """
    if channels not in CHANNELS:
        raise InvalidInputError(f"grasp images have {' or '.join(map(str, CHANNELS))} channels, not {channels!r}")
    views = VIEWS if channels == 12 else VIEWS[:1]
    images = np.zeros((len(areas), channels, SIZE, SIZE), np.float32)
    points, normals = (np.ascontiguousarray(value, np.float32) for value in (areas.points, areas.normals))
    offsets = np.ascontiguousarray(areas.offsets, np.int64)

    for_each_range(_draw, len(areas), 50_000, points, normals, offsets, views, channels // len(views), images)
    return images


@compiled
def _draw(begin, end, points, normals, offsets, views, layers, images):  # type: ignore[no-untyped-def]
    """``layers``: channels of a view, 3 or 4."""
    size = images.shape[2]
    count = np.zeros((size, size), np.int32)
    total = np.zeros((size, size, 4), np.float32)
    for g in range(begin, end):
        first, last = offsets[g], offsets[g + 1]
        for v in range(len(views)):
            row, column, depth = views[v]
            for e in range(first, last):
                i = min(max(int(points[e, row] * size), 0), size - 1)
                j = min(max(int(points[e, column] * size), 0), size - 1)
                count[i, j] += 1
                for a in range(3):
                    total[i, j, a] += abs(normals[e, a])
                total[i, j, 3] += np.float32(1.0) - points[e, depth]
            largest = np.zeros(2, np.float32)  # of the normals, of the heights
            for e in range(first, last):
                i = min(max(int(points[e, row] * size), 0), size - 1)
                j = min(max(int(points[e, column] * size), 0), size - 1)
                if count[i, j] == 0:  # written already
                    continue
                for a in range(layers):
                    value = total[i, j, a] / count[i, j]
                    largest[a // 3] = max(largest[a // 3], value)
                    for m in range(max(i - 1, 0), min(i + 2, size)):
                        for n in range(max(j - 1, 0), min(j + 2, size)):
                            images[g, layers * v + a, m, n] = max(images[g, layers * v + a, m, n], value)
                count[i, j] = 0
                total[i, j] = 0.0
            for a in range(layers):
                if largest[a // 3] > 0.0:
                    images[g, layers * v + a] /= largest[a // 3]
