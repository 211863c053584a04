"""The picture of a study: each metric against the gripper's width, a curve for each method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = ("#1b6e9c", "#c0392b", "#7a8794", "#d58a1d", "#4d8b57", "#7d5a9e", "#2f3b47", "#b0688a")
"""Of the methods, in their order."""
MARKERS = "os^Dvphx"
_APART = 0.04
"""Points of one width stand apart by this share of the step between widths, so that no bar hides another."""


class Panel(NamedTuple):
    """One metric."""

    title: str
    mean: str
    """Where a summary has it."""


PANELS = (
    Panel("free of collision (CFR)", "cfr"),
    Panel("antipodal score (AS)", "antipodal"),
    Panel("AS, colliding ones as 0 (AS(w/ C))", "antipodal_with_collisions"),
    Panel("labelled grasps covered (TCR)", "coverage"),
)
HELD = Panel("best grasp held in physics", "held")


def draw_curves(document: Mapping[str, Any], path: Path, trained_widths: Sequence[float] = ()) -> None:
    """Write the picture (.png) of a document that ``study_document`` made or ``read_document`` read.

    Bars are standard errors over scenes.

    Args:
        document: with the summaries.
        path: of the picture.
        trained_widths: marked, as those that networks were trained for [m].
    """
    rows = [row for row in document["summaries"] if row["width"] is not None]
    executed = any(row["held"] for row in rows)
    panels = [*PANELS, HELD] if executed else PANELS
    style: Any = {"font.family": "DejaVu Sans", "font.size": 10, "axes.titlesize": 11}
    with plt.rc_context(style):
        figure, axes = plt.subplots(2, 3 if executed else 2, figsize=(11.4 if executed else 7.8, 6.6), dpi=120)
        for axis, panel in zip(axes.ravel(), panels, strict=False):
            draw_panel(axis, panel, rows, trained_widths)
        for axis in axes[-1]:
            axis.set_xlabel("gripper width W [cm]")
        _finish(figure, axes.ravel(), executed, bool(trained_widths))
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
        plt.close(figure)


def draw_panel(axis: Axes, panel: Panel, rows: Sequence[Mapping[str, Any]], trained_widths: Sequence[float]) -> None:
    """One metric of all methods."""
    for width in trained_widths:
        axis.axvline(100.0 * width, color="#c9d1d9", linewidth=5.0, alpha=0.6, zorder=0)
    models = list(dict.fromkeys(row["model"] for row in rows))
    widths = sorted({100.0 * row["width"] for row in rows})
    step = _APART * min(np.diff(widths), default=1.0)
    for number, model in enumerate(models):
        points = [(100.0 * row["width"], *value_of(row, panel)) for row in rows if row["model"] == model]
        x, y, error = np.array(sorted(points), float).T
        x = x + step * (number - 0.5 * (len(models) - 1))
        axis.errorbar(
            x, y, yerr=np.nan_to_num(error), marker=MARKERS[number % len(MARKERS)], markersize=5.0, linewidth=1.6,
            capsize=2.5, color=COLOURS[number % len(COLOURS)], label=model,
        )  # fmt: skip
    axis.set_title(panel.title)
    axis.set_ylim(bottom=0.0, top=None if panel.mean == "coverage" else 1.02)
    axis.set_xticks(widths, [f"{width:g}" for width in np.round(widths, 3)])
    axis.margins(x=0.06)
    axis.grid(color="#e6e9ee", linewidth=0.8)
    axis.set_axisbelow(True)


def value_of(row: Mapping[str, Any], panel: Panel) -> tuple[float, float]:
    """Mean and standard error of a summary; NaN where there is none."""
    if panel is HELD:
        pair = (row["held"]["mean"], row["held"]["error"]) if row["held"] else (None, None)
    else:
        pair = (row[panel.mean], row["errors"][panel.mean])
    return tuple(np.nan if value is None else value for value in pair)  # type: ignore[return-value]


def _finish(figure: Figure, axes: Sequence[Axes], executed: bool, trained: bool) -> None:
    """The legend: in the cell that is left over, or below."""
    handles, labels = axes[0].get_legend_handles_labels()
    if trained:
        handles.append(plt.Line2D([], [], color="#c9d1d9", linewidth=5.0, alpha=0.6))
        labels.append("widths of the training")
    if executed:
        axes[-1].axis("off")
        axes[-1].legend(handles, labels, loc="center", frameon=False)
        axes[2].set_xlabel("gripper width W [cm]")
        figure.tight_layout()
    else:
        columns = min(len(labels), 4)
        lines = -(-len(labels) // columns)
        figure.legend(handles, labels, loc="lower center", ncols=columns, frameon=False)
        figure.tight_layout(rect=(0.0, 0.02 + 0.035 * lines, 1.0, 1.0))
