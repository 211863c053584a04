"""What ``regnet detect`` prints for people."""

from __future__ import annotations

import sys

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from regnet_core.cli.results import Result
from regnet_core.geometry import Array
from regnet_core.report import DetectionReport

_PLAIN_WIDTH = 100
"""Columns where the output is not a terminal."""


def make_console() -> Console:
    """A console on stdout that does not squeeze tables when it is redirected."""
    return Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH, highlight=False)


def print_result(console: Console, result: Result, top: int) -> None:
    """Where the cloud came from, what each step did, the best grasps, and the selected one or the reason for none."""
    source, report = result.source, result.detection.report
    grasps, frame = result.detection.grasps, f" in frame '{source.frame}'" if source.frame else ""
    console.print()
    console.print(f"[bold]{escape(source.label)}[/bold]: {len(source.points)} points{escape(frame)}")
    console.print(
        f"{report.model} on {report.device}, gripper width {_mm(result.detection.gripper.width)} mm: "
        f"[bold]{len(grasps)} grasps[/bold] in {1000 * report.total_seconds:.0f} ms"
    )
    console.print(_steps_table(report))
    for warning in report.warnings:
        console.print(f"[yellow]warning:[/yellow] {escape(warning)}", soft_wrap=True)
    if result.selection is None:
        console.print(f"[bold red]no grasp:[/bold red] {escape(report.reason or 'none was selected')}", soft_wrap=True)
        return
    if top:
        console.print(_grasp_table(result, top))
    rank = result.selection.rank
    console.print(
        f"[bold green]selected:[/bold green] rank {rank} by the {result.policy} policy (score "
        f"{result.selection.score:.3f}), centre {_vector(grasps.translation[rank]).strip()} m, opening "
        f"{_mm(float(grasps.width[rank]))} mm",
        soft_wrap=True,
    )


def _steps_table(report: DetectionReport) -> Table:
    table = Table("step", box=None, pad_edge=False, header_style="dim")
    for name in ("kept", "rejected", "ms"):
        table.add_column(name, justify="right")
    for step in report.steps:
        table.add_row(step.name, str(step.kept), str(step.rejected), f"{1000 * step.seconds:.1f}")
    return table


def _grasp_table(result: Result, top: int) -> Table:
    grasps, selected = result.detection.grasps, result.selection.rank if result.selection else -1
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="bold")
    table.add_column("")
    for name in ("rank", "quality", "vertical", "score", "width [mm]", "centre x y z [m]", "approach x y z"):
        table.add_column(name, justify="right", no_wrap=True)
    ranks = list(range(min(top, len(grasps))))
    if selected >= len(ranks):
        ranks.append(selected)
    for rank in ranks:
        chosen = rank == selected
        table.add_row(
            ">" if chosen else "",
            str(rank),
            f"{grasps.quality[rank]:.3f}",
            f"{grasps.vertical_score[rank]:.3f}",
            f"{result.scores[rank]:.3f}",
            _mm(float(grasps.width[rank])),
            _vector(grasps.translation[rank]),
            _vector(grasps.approach[rank], digits=2),
            style="bold green" if chosen else None,
        )
    return table


def _vector(values: Array, digits: int = 3) -> str:
    return " ".join(f"{float(value):{digits + 3}.{digits}f}" for value in values)


def _mm(metres: float) -> str:
    return f"{1000 * metres:.0f}"
