"""``regnet inspect``: what is in a data set."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from regnet_core.cli.needs import needs
from regnet_core.cli.pictures import check_view, write_views
from regnet_core.cli.tables import make_console
from regnet_core.errors import InvalidInputError

if TYPE_CHECKING:
    from regnet_core.data.storage.archive import SceneArchive
    from regnet_core.data.storage.statistics import Statistics

DAMAGED = 4


def inspect(
    folder: Annotated[Path, typer.Argument(help="A data set made by `regnet generate`.", show_default=False)],
    view_file: Annotated[
        Path | None, typer.Option("--view", help="Draw a scene with confidence and best grasps: .png, or .html.")
    ] = None,
    scene: Annotated[int | None, typer.Option(help="Scene to draw.", show_default="the first one")] = None,
    camera: Annotated[int | None, typer.Option(help="Which of its views to draw.", show_default="0")] = None,
    width: Annotated[
        list[float] | None,
        typer.Option("--gripper-width", "-w", help="Widths to draw.", show_default="the least and the largest"),
    ] = None,
    verify: Annotated[
        bool,
        typer.Option("--verify", help=f"Compare all files with their checksums; exit code {DAMAGED} if one differs."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the statistics as JSON.")] = False,
) -> None:
    """Print the statistics of a data set beside those of the paper, or draw one of its scenes."""
    with needs("inspect", "data"):
        from regnet_core.data.storage.archive import SceneArchive
        from regnet_core.data.storage.manifest import damaged_files
        from regnet_core.data.storage.statistics import statistics
    _check_options(view_file, scene, camera, width, verify, as_json)
    if verify and (damaged := damaged_files(folder)):
        typer.echo(f"damaged: {', '.join(damaged)}")
        raise typer.Exit(DAMAGED)
    archive = SceneArchive(folder)
    if view_file is not None:
        _draw(archive, view_file, scene, camera or 0, width)
        return
    if not len(archive):
        raise InvalidInputError(f"'{folder}' has no finished shard of scenes yet; run `regnet generate` to its end")
    result = statistics(archive)
    if as_json:
        typer.echo(json.dumps(dataclasses.asdict(result)))
        return
    _print(archive, result)
    if verify:
        typer.echo("every file has its checksum")


def _check_options(
    view: Path | None, scene: int | None, camera: int | None, width: list[float] | None, verify: bool, as_json: bool
) -> None:
    """Refuse what would be ignored."""
    drawing = {"--scene": scene, "--camera": camera, "--gripper-width": width}
    if view is None:
        for name, value in drawing.items():
            if value is not None:
                raise InvalidInputError(f"{name} says what to draw: it needs --view FILE.png")
    elif verify or as_json:
        raise InvalidInputError("--view draws and prints nothing: give --verify or --json in a call of its own")


def _print(archive: SceneArchive, result: Statistics) -> None:
    from regnet_core.data.storage.statistics import PAPER_TABLE

    console, settings = make_console(), archive.manifest.settings
    kinds = ", ".join(f"{count} {kind}" for kind, count in result.kinds.items())
    state = "complete" if archive.manifest.complete else f"unfinished, {settings.scenes} wanted"
    console.print(
        f"{result.scenes} scenes ({kinds}; {state}), {result.views} views, {result.objects:.1f} objects in a scene, "
        f"{len(archive.manifest.objects)} objects of the split {settings.split}, seed {settings.seed}",
        soft_wrap=True,
    )
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for name in ("width [m]", "found", "stored", "antipodal", "centre", "s_q > 0.9", "paper: grasps"):
        table.add_column(name, justify="right")
    for name in ("antipodal", "centre"):
        table.add_column(f"paper: {name}", justify="right")
    for row in result.widths:
        paper = PAPER_TABLE.get(row.width)
        table.add_row(
            f"{row.width:g}",
            f"{row.found:.0f}",
            f"{row.stored.grasps:.0f}",
            f"{row.stored.antipodal_score:.4f}",
            f"{row.stored.centre_score:.4f}",
            f"{100 * row.good:.0f} %",
            *(
                ("", "", "")
                if paper is None
                else (f"{paper.grasps:.0f}", f"{paper.antipodal_score:.4f}", f"{paper.centre_score:.4f}")
            ),
        )
    console.print(table)


def _draw(archive: SceneArchive, path: Path, scene: int | None, camera: int, widths: list[float] | None) -> None:
    from regnet_core.data.storage.pictures import label_scenes

    check_view(path)
    views = archive.manifest.settings.views
    if not 0 <= camera < views:
        raise InvalidInputError(f"--camera must be in [0, {views - 1}] for this data set, got {camera}")
    there = archive.widths
    unknown = sorted(set(widths or ()) - set(there))
    if unknown:
        raise InvalidInputError(f"the data set has the widths {', '.join(map(str, there))} m, not {unknown[0]}")
    if scene is None:
        scene = next(iter(archive), 0)
    chosen = widths or sorted({min(there), max(there)})
    for file in write_views(path, label_scenes(archive, scene, camera, chosen)):
        typer.echo(f"wrote {file}")
