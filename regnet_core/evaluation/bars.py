"""The picture of the main table: each metric as a bar for each method."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from regnet_core.evaluation.curves import COLOURS, HELD, PANELS, plt, value_of


def draw_bars(document: Mapping[str, Any], path: Path) -> None:
    """Write the picture (.png) of a document that ``study_document`` made or ``read_document`` read.

    Bars are means over all results; their ends, standard errors over scenes.
    """
    rows = [row for row in document["summaries"] if row["width"] is None and row["kind"] is None]
    panels = [*PANELS, HELD] if any(row["held"] for row in rows) else PANELS
    names, place = [row["model"] for row in rows], np.arange(len(rows))[::-1]
    style: Any = {"font.family": "DejaVu Sans", "font.size": 10, "axes.titlesize": 11}
    with plt.rc_context(style):
        size = (3.0 * len(panels) + 1.4, 0.42 * len(rows) + 1.1)
        figure, axes = plt.subplots(1, len(panels), sharey=True, figsize=size, dpi=120, squeeze=False)
        for axis, panel in zip(axes[0], panels, strict=True):
            # What is unknown, as the error of a single scene, is drawn as nothing.
            values = np.nan_to_num(np.array([value_of(row, panel) for row in rows], float))
            colours = [COLOURS[number % len(COLOURS)] for number in range(len(rows))]
            axis.barh(place, values[:, 0], xerr=values[:, 1], color=colours, height=0.7,
                      error_kw={"ecolor": "#2f3b47", "capsize": 2.0, "elinewidth": 1.0})  # fmt: skip
            for y, (mean, error) in zip(place, values, strict=True):
                axis.text(mean + error + 0.015, y, f"{mean:.3f}", va="center", fontsize=8.5)
            axis.set_title(panel.title.replace(", colliding", ",\ncolliding"))
            axis.set_xlim(0.0, 1.18 if values[:, 0].max() > 0.6 else max(1.35 * values.sum(axis=1).max(), 0.1))
            axis.grid(axis="x", color="#e6e9ee", linewidth=0.8)
            axis.set_axisbelow(True)
        axes[0, 0].set_yticks(place, names)
        figure.tight_layout()
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
        plt.close(figure)
