"""Counts how often methods ask for more than the gripper opens, on objects that are wider than it.

    python tools/study_width.py data/test --model regnetv2-s --model blind/weights.safetensors [--out docs/width.png]

In each scene with objects of 7 to 9 cm (across: the least distance of two upright planes that hold the object as it
lies), each method is told a width, and what it proposes on these objects is measured on the true meshes: the extent
along the closing direction of what is between the fingers. "proposed" is what the method gives, "final" what the
detector returns after its checks of collision, "best 100" the first of these. A network
that does not know the width is the control.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from regnet_core.cli.tables import make_console
from regnet_core.data.generation.executors import LocalExecutor
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.evaluation.curves import COLOURS
from regnet_core.evaluation.observed import POINTS, RecordedViews
from regnet_core.evaluation.summary import Estimate
from regnet_core.evaluation.too_wide import Asked, Row, TooWideSettings, run_too_wide, summarise_too_wide

BINS = np.arange(0.0, 0.1401, 0.005)
"""Of the histogram [m]."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="a data set made by `regnet generate`")
    parser.add_argument("--model", action="append", required=True, help="name, or .safetensors; several times")
    parser.add_argument("--scenes", type=int, help="the first so many (default: all)")
    parser.add_argument("--width", type=float, action="append", help="W that is told [m] (default: 0.06 and 0.12)")
    parser.add_argument("--across", type=float, nargs=2, default=(0.07, 0.09), help="sizes of objects [m] (0.07 0.09)")
    parser.add_argument("--points", type=int, default=POINTS, help=f"most points of a cloud ({POINTS})")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--workers", type=int, default=0, help="processes (default: one for each core)")
    parser.add_argument("--out", type=Path, help="picture (.png)")
    arguments = parser.parse_args()
    archive = SceneArchive(arguments.data)
    settings = TooWideSettings(
        models=tuple(arguments.model),
        scenes=archive.indices[: arguments.scenes],
        widths=tuple(arguments.width or TooWideSettings.widths),
        across=tuple(arguments.across),
        clouds=RecordedViews(arguments.points, arguments.seed),
        seed=arguments.seed,
        device=arguments.device,
    )
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("asking")
        results = run_too_wide(
            archive,
            settings,
            LocalExecutor(arguments.workers),
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    console = make_console()
    low, high = (100.0 * size for size in settings.across)
    scenes = len({asked.scene for asked in results})
    console.print(
        f"{scenes} scenes have objects of {low:g} to {high:g} cm; shares of the grasps on them that need more"
    )
    rows = summarise_too_wide(results)
    console.print(table(rows))
    if arguments.out is not None and rows:
        draw(results, rows, settings.across, arguments.out)
        console.print(f"wrote {arguments.out}")


def table(rows: Sequence[Row]) -> Table:
    """A line for each width and method; shares in percent, with their standard errors over scenes."""
    least = 100.0 * min((row.width for row in rows), default=0.0)
    result = Table(box=SIMPLE_HEAD, pad_edge=False)
    result.add_column("W [cm]", justify="right")
    result.add_column("method", overflow="fold")
    for stage in ("proposed", "final"):
        for name in (stage, "> W [%]", f"> {least:g} cm [%]"):
            result.add_column(name, justify="right")
    result.add_column("best 100 > W [%]", justify="right")
    for row in rows:
        numbers = [
            text
            for share in (row.proposed, row.final)
            for text in (str(share.count), percent(share.above_told), percent(share.above_least))
        ]
        result.add_row(f"{100.0 * row.width:g}", row.model, *numbers, percent(row.best.above_told))
    return result


def percent(share: Estimate) -> str:
    """With its error, where there is any."""
    if np.isnan(share.mean):
        return "-"
    return f"{100.0 * share.mean:.1f}" + ("" if np.isnan(share.error) else f" ±{100.0 * share.error:.1f}")


def draw(results: Sequence[Asked], rows: Sequence[Row], across: tuple[float, float], out: Path) -> None:
    """What proposals need, and how many need more than the least width that was told."""
    width = min(row.width for row in rows)
    plt.rcParams.update({"font.family": "DejaVu Sans", "font.size": 10, "axes.titlesize": 11})
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.4, 4.2), dpi=120, width_ratios=(1.5, 1.0))
    draw_needed(left, results, width, across)
    draw_shares(right, [row for row in rows if row.width == width])
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=len(labels), frameon=False)
    figure.tight_layout(rect=(0.0, 0.07, 1.0, 1.0))
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)


def draw_needed(axis: Axes, results: Sequence[Asked], width: float, across: tuple[float, float]) -> None:
    """Histogram of what proposals need when a width is told."""
    axis.axvspan(*(100.0 * size for size in across), color="#eef1f4", zorder=0, label="the objects' size across")
    axis.axvline(100.0 * width, color="#20242b", linewidth=1.2, linestyle="--", label="W as told")
    for number, model in enumerate(dict.fromkeys(asked.model for asked in results)):
        own = [asked.proposed for asked in results if asked.model == model and asked.width == width]
        needed = np.concatenate(own)
        share = np.histogram(np.minimum(needed, BINS[-1] - 1e-6), BINS)[0] / max(1, len(needed))
        axis.stairs(100.0 * share, 100.0 * BINS, color=COLOURS[number % len(COLOURS)], linewidth=1.8, label=model)
    axis.set(xlim=(0.0, 100.0 * BINS[-1]), xlabel="needed opening [cm], the last bin up to any", ylabel="proposals [%]")
    axis.set_ylim(bottom=0.0)
    axis.set_title(f"proposals for W = {100.0 * width:g} cm, before any check")
    axis.grid(color="#e6e9ee", linewidth=0.8)
    axis.set_axisbelow(True)


def draw_shares(axis: Axes, rows: Sequence[Row]) -> None:
    """Share of proposals and of final grasps that need more than W; bars are standard errors."""
    for number, row in enumerate(rows):
        for offset, share, alpha in ((-0.27, row.proposed, 1.0), (0.0, row.final, 0.6), (0.27, row.best, 0.3)):
            height, error = (100.0 * np.nan_to_num(value) for value in share.above_told)
            axis.bar(
                number + offset, height, 0.26, yerr=error, capsize=3, color=COLOURS[number % len(COLOURS)], alpha=alpha
            )
            axis.annotate(
                f"{height:.1f}", (number + offset, height + error), xytext=(0, 3), textcoords="offset points",
                ha="center", fontsize=9,
            )  # fmt: skip
    axis.set_xticks(range(len(rows)), [row.model.replace("/", "/\n") for row in rows])
    axis.set_ylabel("need more than W [%]")
    axis.set_title("proposed, final, best 100 (pale)")
    axis.margins(y=0.15)
    axis.grid(axis="y", color="#e6e9ee", linewidth=0.8)
    axis.set_axisbelow(True)


if __name__ == "__main__":
    main()
