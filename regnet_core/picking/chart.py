"""The picture of a study: what became of all attempts of each method, and how much of each bin was cleared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from regnet_core.picking.summary import FAILURES

_SUCCESS = "#4d8b57"
_COLOURS = ("#d9a441", "#c0392b", "#7d5a9e", "#1b6e9c")
"""Of the classes of failures, in their order."""
_ROW = 0.42
"""Height of a bar with its gap [inch]."""


def draw_chart(document: Mapping[str, Any], path: Path) -> None:
    """Write the picture (.png) of a document that `study_document` made.

    A bar is all attempts of a scene, model, policy and camera: those that succeeded, then each class of failures. The
    diamond is the completion rate with its standard error.

    Args:
        document: with the summaries.
        path: of the picture.
    """
    rows: Sequence[Mapping[str, Any]] = document["summaries"]
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    heights = [sum(row["scene"] == scene for row in rows) for scene in scenes]
    size = (9.6, 1.3 + _ROW * sum(heights) + 0.45 * len(scenes))
    with plt.rc_context({"font.family": "DejaVu Sans", "font.size": 9.5, "axes.titlesize": 11}):
        figure, axes = plt.subplots(
            len(scenes), 1, figsize=size, dpi=120, sharex=True, squeeze=False, height_ratios=[h + 0.6 for h in heights]
        )
        for axis, scene in zip(axes[:, 0], scenes, strict=True):
            _draw_scene(axis, scene, [row for row in rows if row["scene"] == scene])
        axes[-1, 0].set_xlabel("share of the attempts; completion rate  [%]")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="lower center", ncols=len(labels), frameon=False, columnspacing=1.2)
        figure.tight_layout(rect=(0.0, 0.36 / size[1], 1.0, 1.0))
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
        plt.close(figure)


def _draw_scene(axis: Axes, scene: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """The bars of one scene, the first on top."""
    at = -np.arange(len(rows), dtype=float)
    attempts = np.array([max(row["attempts"], 1) for row in rows], float)
    left = np.zeros(len(rows))
    for name, colour in zip(("placed", *FAILURES), (_SUCCESS, *_COLOURS), strict=True):
        counts = [row["successes"] if name == "placed" else row["failures"][name] for row in rows]
        share = 100.0 * np.array(counts, float) / attempts
        axis.barh(at, share, left=left, height=0.72, color=colour, label=name)
        left += share
    rates = [row["completion_rate"] for row in rows]
    mean = [100.0 * rate["mean"] for rate in rates]
    error = [100.0 * (rate["error"] or 0.0) for rate in rates]
    axis.errorbar(
        mean, at, xerr=error, fmt="D", color="#10151c", markerfacecolor="white", markersize=5.0, capsize=2.5,
        label="completion rate",
    )  # fmt: skip
    for y, row in zip(at, rows, strict=True):
        rate = row["success_rate"]["mean"]
        if rate is not None:
            axis.text(1.0, y, f"{100.0 * rate:.0f}", va="center", color="white", fontsize=9)
    axis.set_yticks(at, [f"{row['model']}, {row['policy']}, {row['camera']}" for row in rows])
    axis.set_xlim(0.0, 103.0)
    axis.set_title(f"{scene}, {min(row['episodes'] for row in rows)} episodes of each camera", loc="left")
    axis.grid(axis="x", color="#e6e9ee", linewidth=0.8)
    axis.set_axisbelow(True)
