"""Statistics of a data set, as in Table 1 of REGNet V2."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from regnet_core.data.storage.archive import SceneArchive


class TableRow(NamedTuple):
    """One row of Table 1: means over scenes (of the number) and over grasps (of the scores)."""

    grasps: float
    antipodal_score: float
    centre_score: float


PAPER_TABLE = {
    0.06: TableRow(883, 0.5648, 0.8654),
    0.08: TableRow(1373, 0.5801, 0.8665),
    0.10: TableRow(2029, 0.5472, 0.8835),
    0.12: TableRow(2450, 0.5420, 0.8914),
}
"""Table 1 of the paper, by gripper width [m]."""


@dataclass(frozen=True)
class WidthStatistics:
    """Of the labels of one width.

    Attributes:
        width: [m].
        found: mean number of grasps found in a scene.
        stored: means of those stored, in the paper's columns.
        good: share of the stored grasps with s_q > 0.9.
    """

    width: float
    found: float
    stored: TableRow
    good: float


@dataclass(frozen=True)
class Statistics:
    """Of a data set.

    Attributes:
        scenes: number of scenes.
        views: number of views.
        kinds: number of scenes of each kind.
        objects: mean number of objects in a scene.
        redrawn: number of scenes that were drawn more than once.
        widths: one entry for each gripper width.
    """

    scenes: int
    views: int
    kinds: dict[str, int]
    objects: float
    redrawn: int
    widths: tuple[WidthStatistics, ...]


def statistics(archive: SceneArchive) -> Statistics:
    """Reads every scene's labels once."""
    infos = [archive.info(index) for index in archive]
    count = np.zeros((len(infos), len(archive.widths)))
    sums = np.zeros((len(archive.widths), 3))
    for row, index in enumerate(archive):
        for w, (labels, width) in enumerate(zip(archive.labels(index), archive.widths, strict=True)):
            count[row, w] = len(labels)
            sums[w] += labels.score.sum(), labels.centre_score(width).sum(), (labels.score > 0.9).sum()
    found = np.array([info.found for info in infos], float).reshape(count.shape)
    total = np.maximum(count.sum(axis=0), 1.0)
    scenes = max(len(infos), 1)
    return Statistics(
        scenes=len(infos),
        views=sum(len(info.views) for info in infos),
        kinds=dict(sorted(Counter(info.kind for info in infos).items())),
        objects=sum(len(info.objects) for info in infos) / scenes,
        redrawn=sum(info.redraws > 0 for info in infos),
        widths=tuple(
            WidthStatistics(
                width,
                float(found[:, w].sum() / scenes),
                TableRow(float(count[:, w].sum() / scenes), *(float(v) for v in sums[w, :2] / total[w])),
                float(sums[w, 2] / total[w]),
            )
            for w, width in enumerate(archive.widths)
        ),
    )
