"""A picture of a document: the stages of every run stacked up, and how near to the peak its heavy stages are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.records import Document, LatencyRecord, RunRecord, StageRecord
from regnet_core.errors import InvalidInputError

_SHOWN = 0.03
"""Stages of less than this share of every run's detection are put together."""
_HEAVY = 0.05
_INCH_OF_BAR, _INCHES_AROUND, _WIDTH = 0.42, 1.6, 13.0
_OTHERS = "all smaller ones"


def draw(document: Document, path: Path) -> None:
    """Write the picture; the suffix (.png, .svg, .pdf) says as what.

    Raises:
        InvalidInputError: the document has nothing to draw, or matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InvalidInputError("pictures need matplotlib: pip install 'regnet_ros[data]' brings it") from error
    panels: list[tuple[int, Callable[[Any, Any], None], Sequence[Any]]] = [
        (len(document.runs), _draw_stages, document.runs),
        (sum(len(_heavy(run)) for run in document.runs), _draw_shares, document.runs),
        (len(document.latencies), _draw_latencies, document.latencies),
    ]
    panels = [panel for panel in panels if panel[0] > 0]
    if not panels:
        raise InvalidInputError("the document has neither runs nor end-to-end measurements to draw")
    heights = [_INCHES_AROUND + _INCH_OF_BAR * count for count, _, _ in panels]
    figure = Figure(figsize=(_WIDTH, sum(heights)), layout="constrained")
    axes = figure.subplots(len(panels), 1, height_ratios=heights, squeeze=False)[:, 0]
    for axis, (_, fill, records) in zip(axes, panels, strict=True):
        fill(axis, records)
    machine = document.machine
    figure.suptitle(f"{machine.processor}, {machine.cores} cores, {document.created[:10]}", fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _draw_stages(axis: Any, runs: Sequence[RunRecord]) -> None:
    names = _shown(runs)
    colours = _colours(len(names) + 1)
    left = [0.0] * len(runs)
    for name, colour in zip([*names, _OTHERS], colours, strict=True):
        widths = [1e3 * _seconds(run, name, names) for run in runs]
        axis.barh(range(len(runs)), widths, left=left, color=colour, label=name, edgecolor="white", linewidth=0.4)
        left = [start + width for start, width in zip(left, widths, strict=True)]
    for row, run in enumerate(runs):
        axis.text(left[row], row, f" {1e3 * run.total.median:.0f} ms", va="center", fontsize=8)
    _bars(axis, [run.label for run in runs], "a detection, cloud to ranked grasps: medians of its stages [ms]")
    axis.set_xlim(0, 1.08 * max(left))
    axis.legend(fontsize=7, ncols=6, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)


def _draw_shares(axis: Any, runs: Sequence[RunRecord]) -> None:
    labels, shares, colours = [], [], []
    for run in runs:
        for stage in _heavy(run):
            labels.append(f"{run.label}: {stage.name}")
            shares.append(100 * (stage.share or 0.0))
            colours.append("#4477aa" if stage.bound == "matrix product" else "#cc9944")
    axis.barh(range(len(labels)), shares, color=colours)
    for row, share in enumerate(shares):
        axis.text(share, row, f" {share:.0f} %", va="center", fontsize=8)
    axis.axvline(100.0, color="grey", linewidth=0.8)
    _bars(axis, labels, "share of the machine's peak [%]: of matrix products (blue), of memory traffic (yellow)")


def _draw_latencies(axis: Any, latencies: Sequence[LatencyRecord]) -> None:
    parts = ("model", "rest of the detection", "before the detection", "transport")
    left = [0.0] * len(latencies)
    for part, colour in zip(parts, _colours(len(parts)), strict=True):
        widths = [1e3 * _part(item, part) for item in latencies]
        axis.barh(range(len(latencies)), widths, left=left, color=colour, label=part)
        left = [start + width for start, width in zip(left, widths, strict=True)]
    for row, item in enumerate(latencies):
        axis.text(left[row], row, f" {1e3 * item.total.median:.0f} ms", va="center", fontsize=8)
    labels = [f"{item.model}, {item.threads} threads, {item.cloud}" for item in latencies]
    _bars(axis, labels, "from the publication of the cloud to the arrival of the grasps [ms]")
    axis.set_xlim(0, 1.08 * max(left))
    axis.legend(fontsize=7, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)


def _bars(axis: Any, labels: Sequence[str], title: str) -> None:
    axis.set_yticks(range(len(labels)), labels, fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel(title, fontsize=9)
    axis.spines[["top", "right"]].set_visible(False)


def _shown(runs: Sequence[RunRecord]) -> list[str]:
    """The stages of detections that are drawn on their own, in their order."""
    names: dict[str, None] = {}
    for run in runs:
        for stage in _of_detector(run):
            if stage.wall.median >= _SHOWN * run.total.median:
                names[stage.name] = None
    order = {stage.name: i for run in runs for i, stage in enumerate(_of_detector(run))}
    return sorted(names, key=lambda name: order[name])


def _seconds(run: RunRecord, name: str, shown: Sequence[str]) -> float:
    own = _of_detector(run)
    if name == _OTHERS:
        return sum(stage.wall.median for stage in own if stage.name not in shown)
    return sum(stage.wall.median for stage in own if stage.name == name)


def _of_detector(run: RunRecord) -> list[StageRecord]:
    return [stage for stage in run.stages if stage.part == "detector"]


def _heavy(run: RunRecord) -> list[StageRecord]:
    """The stages of the network that have a share of the peak and take a good part of the time."""
    return [
        stage
        for stage in _of_detector(run)
        if stage.share is not None and stage.wall.median >= _HEAVY * run.total.median
    ]


def _part(item: LatencyRecord, part: str) -> float:
    proposals, detection, transport = (s.median for s in (item.proposals, item.detection, item.transport))
    lengths = {
        "model": proposals,
        "rest of the detection": detection - proposals,
        "transport": max(transport, 0.0),
        "before the detection": item.total.median - detection - max(transport, 0.0),
    }
    return max(lengths[part], 0.0)


def _colours(count: int) -> list[Any]:
    from matplotlib import colormaps

    palette = [*colormaps["tab20"].colors, *colormaps["tab20b"].colors]  # type: ignore[attr-defined]
    return [palette[i % len(palette)] for i in range(count)]
