"""What ``regnet simulate`` prints: for people, and as Markdown for a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

Row = Mapping[str, Any]
_TEXT = ("scene", "model", "policy", "camera")
_FAILURES = {
    "unstable": "unstable",
    "collision": "collision",
    "gripper limit": "limit",
    "more than one object": "several",
}
"""Classes of failures, and the titles of their columns."""
_COLUMNS = (*_TEXT, "SR [%]", "CR [%]", "attempts", *_FAILURES.values())


def print_simulation(console: Console, document: Mapping[str, Any]) -> None:
    """Rates with standard errors, and the number of failures of each class."""
    rows: Sequence[Row] = document["summaries"]
    settings = document["settings"]
    console.print(
        f"gripper {settings['width']:g} m wide, {settings['episodes']} episodes of each scene and camera, seed "
        f"{settings['seed']}"
    )
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for name in _COLUMNS:
        if name in _TEXT:
            table.add_column(name, overflow="fold")
        else:
            table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*_cells(row))
    console.print(table)
    console.print(f"episodes ended: {_ends(rows)}", soft_wrap=True)
    console.print(f"success without a touch before closing: {_untouched(rows)} of all attempts", soft_wrap=True)


def markdown(document: Mapping[str, Any]) -> str:
    """The same table for a page."""
    lines = ["| " + " | ".join(_COLUMNS) + " |", "|" + "---|" * len(_COLUMNS)]
    lines += ["| " + " | ".join(_quoted(row)) + " |" for row in document["summaries"]]
    return "\n".join(lines)


def print_attempts(console: Console, record: Mapping[str, Any]) -> None:
    """What happened in each attempt of an episode."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for name, justify in (("attempt", "right"), ("outcome", "left"), ("quality", "right"), ("what happened", "left")):
        table.add_column(name, justify="right" if justify == "right" else "left", overflow="fold")
    for number, attempt in enumerate(record["attempts"]):
        outcome, colour = attempt["failure"] or "placed", "red" if attempt["failure"] else "green"
        quality = f"{attempt['grasp']['quality']:.2f}"
        table.add_row(str(number), f"[{colour}]{outcome}[/{colour}]", quality, attempt["message"])
    console.print(table)
    placed = sum(len(attempt["placed"]) for attempt in record["attempts"])
    why = f": {record['reason']}" if record["reason"] else ""
    console.print(
        f"{placed} of {len(record['objects'])} objects placed; ended with {record['end']}{why}", soft_wrap=True
    )


def _cells(row: Row) -> list[str]:
    failures = [str(row["failures"][name]) for name in _FAILURES]
    rates = [_rate(row["success_rate"]), _rate(row["completion_rate"])]
    return [*(row[name] for name in _TEXT), *rates, str(row["attempts"]), *failures]


def _quoted(row: Row) -> list[str]:
    scene, model, *rest = _cells(row)
    return [f"`{scene}`", f"`{model}`", *rest]


def _rate(rate: Mapping[str, float | None]) -> str:
    mean, error = rate["mean"], rate["error"]
    if mean is None:
        return "-"
    return f"{100.0 * mean:.1f}" if error is None else f"{100.0 * mean:.1f} ± {100.0 * error:.1f}"


def _ends(rows: Sequence[Row]) -> str:
    counts: dict[str, int] = {}
    for row in _single(rows):
        for end, count in row["ends"].items():
            counts[end] = counts.get(end, 0) + count
    return ", ".join(f"{end} {count}" for end, count in counts.items())


def _untouched(rows: Sequence[Row]) -> str:
    attempts = sum(row["attempts"] for row in _single(rows))
    clean = sum((row["untouched"] or 0.0) * row["attempts"] for row in _single(rows))
    return f"{100.0 * clean / attempts:.1f} %" if attempts else "-"


def _single(rows: Sequence[Row]) -> list[Row]:
    """Without the rows that sum up others."""
    return [row for row in rows if row["camera"] != "all"]
