"""What ``regnet evaluate`` prints for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

METRICS = {"CFR": "cfr", "AS": "antipodal", "AS(w/ C)": "antipodal_with_collisions", "TCR": "coverage"}
"""The paper's names, and where a summary has them."""
TIMES = {"forward": "proposal_seconds", "processing": "processing_seconds", "total": "total_seconds"}
"""Columns of times, in ms."""

Row = Mapping[str, Any]


def print_evaluation(console: Console, document: Mapping[str, Any], *, by_width: bool) -> None:
    """The paper's main table, the same for each width if wanted, and what was executed."""
    summaries: Sequence[Row] = document["summaries"]
    every = [row for row in summaries if row["width"] is None and row["kind"] is None]
    single = [row for row in summaries if row["width"] is not None]
    seeds = len(document["settings"]["seeds"])
    console.print(f"{every[0]['scenes']} scenes, {every[0]['results']} detections of each method, times in ms")
    if seeds > 1:
        console.print(f"± standard deviation over {seeds} seeds")
    console.print(metrics_table(every))
    if by_width:
        console.print(metrics_table(_by_width(single)))
    console.print(f"standard errors over scenes: {_errors(every)}", soft_wrap=True)
    for lead in document["leads"]:
        console.print(_lead(lead), soft_wrap=True)
    if len(document["networks"]) > 1:
        console.print()
        console.print(networks_table(document["networks"]))
    if every[0]["held"] is not None:
        console.print("\nthe best grasp of each detection, executed")
        console.print(execution_table([*every, *(_by_width(single) if by_width else ())]))


def metrics_table(rows: Sequence[Row]) -> Table:
    """CFR, AS, AS(w/ C), TCR, number of kept grasps, and times, a line for each summary."""
    wide = any(row["width"] is not None for row in rows)
    table = _table(wide, [*METRICS, "kept", *TIMES])
    for row in rows:
        numbers = [_with_spread(row[name], row["spread"][name]) for name in METRICS.values()]
        times = [_number(row[name], 0, 1000.0) for name in TIMES.values()]
        table.add_row(*_head(row, wide), *numbers, _number(row["kept"], 1), *times)
    return table


def networks_table(networks: Sequence[Row]) -> Table:
    """What tells the networks apart, as in the paper's ablation table."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="bold")
    table.add_column("network", overflow="fold")
    for name in ("layer", "k1", "anchors", "region [cm]", "passes", "width", "colour", "parameters [M]", "GFLOP"):
        table.add_column(name, justify="right")
    for own in networks:
        numbers = [str(own["layer"]), str(own["positives"]), str(own["anchors"]), _number(own["region"], 1, 100.0)]
        flags = [str(own["passes"]), *("yes" if own[name] else "no" for name in ("width", "colour"))]
        sizes = [_number(own["parameters"], 3, 1e-6), _number(own["flops"], 1, 1e-9)]
        table.add_row(own["label"], *numbers, *flags, *sizes)
    return table


def execution_table(rows: Sequence[Row]) -> Table:
    """Share of the best grasps that were held, and how often each outcome came."""
    wide = any(row["width"] is not None for row in rows)
    outcomes = list(dict.fromkeys(name for row in rows for name in (row["held"] or {"outcomes": {}})["outcomes"]))
    outcomes = ["held", *(name for name in outcomes if name != "held")]
    table = _table(wide, ["held [%]", "tried", *outcomes])
    for row in rows:
        held = row["held"] or {"mean": None, "tried": 0, "outcomes": {}}
        counts = [str(held["outcomes"].get(name, 0)) for name in outcomes]
        table.add_row(*_head(row, wide), _number(held["mean"], 1, 100.0), str(held["tried"]), *counts)
    return table


def _table(wide: bool, columns: Sequence[str]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="bold")
    if wide:
        table.add_column("W [m]", justify="right", no_wrap=True)
    table.add_column("method", overflow="fold")
    for name in columns:
        table.add_column(name, justify="right")
    return table


def _head(row: Row, wide: bool) -> list[str]:
    width = "all" if row["width"] is None else f"{row['width']:g}"
    return [*([width] if wide else []), row["model"]]


def _by_width(rows: Sequence[Row]) -> list[Row]:
    """Widths one after another, each with all methods in their order."""
    return sorted(rows, key=lambda row: float(row["width"]))


def _errors(rows: Sequence[Row]) -> str:
    """The largest of the methods' errors of each metric."""
    found = {title: [row["errors"][name] for row in rows] for title, name in METRICS.items()}
    largest = {title: max((e for e in errors if e is not None), default=None) for title, errors in found.items()}
    return ", ".join(f"{title} {_number(error, 4)}" for title, error in largest.items()) + " at most"


def _lead(lead: Row) -> str:
    title = next(title for title, name in METRICS.items() if name == lead["metric"])
    text = f"{title}: {lead['best']} leads {lead['second']} by {_number(lead['difference'], 4)}"
    text += f", standard error over scenes {_number(lead['error'], 4)}"
    return text if lead["spread"] is None else f"{text}, deviation over seeds {_number(lead['spread'], 4)}"


def _with_spread(value: float | None, spread: float | None) -> str:
    return _number(value, 4) if spread is None else f"{_number(value, 3)} ±{_number(spread, 3)}"


def _number(value: float | None, digits: int, scale: float = 1.0) -> str:
    return "-" if value is None else f"{scale * value:.{digits}f}"
