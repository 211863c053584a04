"""``regnet evaluate``: methods against each other on scenes whose truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from regnet_core.cli.evaluation_tables import print_evaluation
from regnet_core.cli.needs import needs
from regnet_core.cli.results import make_folder
from regnet_core.cli.tables import make_console
from regnet_core.errors import InvalidInputError
from regnet_core.models import DEFAULT_MODEL

if TYPE_CHECKING:
    from regnet_core.data.storage.archive import SceneArchive

_WHAT, _HOW, _OUTPUT = "What to compare", "How", "Output"


def evaluate(
    data: Annotated[Path, typer.Option(help="Data set with the scenes, made by `regnet generate`.")],
    model: Annotated[
        list[str] | None,
        typer.Option(
            help="One of `regnet models`, the path of a network's .safetensors, or all: the paper's main table, as far "
            "as there are weights; give it several times.",
            show_default=DEFAULT_MODEL,
            rich_help_panel=_WHAT,
        ),
    ] = None,
    scenes: Annotated[
        int | None, typer.Option(help="The first so many.", show_default="all", rich_help_panel=_WHAT)
    ] = None,
    views: Annotated[
        str, typer.Option(help="one of each scene, in turn, or all.", metavar="one|all", rich_help_panel=_WHAT)
    ] = "one",
    width: Annotated[
        list[float] | None,
        typer.Option(
            "--gripper-width",
            "-w",
            help="Width in metres that the data set has labels for; give it several times.",
            show_default="all of them",
            rich_help_panel=_WHAT,
        ),
    ] = None,
    points: Annotated[int, typer.Option(help="Most points of a cloud.", rich_help_panel=_HOW)] = 25600,
    seed: Annotated[int, typer.Option(help="Of clouds and methods.", rich_help_panel=_HOW)] = 0,
    seeds: Annotated[
        int, typer.Option(help="So many times, with this seed and those that follow it.", rich_help_panel=_HOW)
    ] = 1,
    device: Annotated[
        str, typer.Option(help="Where networks run: auto, cpu, cuda or cuda:N.", rich_help_panel=_HOW)
    ] = "auto",
    workers: Annotated[
        int, typer.Option(help="Processes, each with one core; 0: one for each core.", rich_help_panel=_HOW)
    ] = 0,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Execute the best grasp of each detection.", rich_help_panel=_HOW)
    ] = False,
    by_width: Annotated[
        bool, typer.Option("--by-width", help="Print each width by itself, too.", rich_help_panel=_OUTPUT)
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Write all results to this .json.", rich_help_panel=_OUTPUT)] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            help="Draw the metrics, against the width where there are several: .png.", rich_help_panel=_OUTPUT
        ),
    ] = None,
    trained_widths: Annotated[
        str | None,
        typer.Option(
            help="Widths in metres to mark in the picture, such as 0.06,0.08,0.10,0.12.",
            show_default=False,
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.", rich_help_panel=_OUTPUT)] = False,
) -> None:
    """Compare methods by the paper's metrics: CFR, AS, AS(w/ C), TCR and time.

    All get the same clouds. Times are those of one core, whatever the number of workers. The results of the same
    command are the same but for the times.
    """
    with needs("evaluate", "data"):
        from regnet_core.data.generation.executors import LocalExecutor
        from regnet_core.data.storage.archive import SceneArchive
        from regnet_core.evaluation.document import study_document, write_document
        from regnet_core.evaluation.observed import RecordedViews
        from regnet_core.evaluation.study import StudySettings, run_seeds
        from regnet_core.evaluation.variants import network_records
    marked = _check_outputs(out, picture, trained_widths)
    archive = SceneArchive(data)
    settings = StudySettings(
        models=_methods(model or [DEFAULT_MODEL]),
        widths=tuple(width or archive.widths),
        scenes=_first(archive, scenes),
        all_views=_all_views(views),
        clouds=RecordedViews(points, seed),
        seed=seed,
        device=device,
        simulate=simulate,
    )
    executor = LocalExecutor(workers)
    with _bar(quiet) as progress:
        task = progress.add_task("evaluating", total=seeds * len(settings.scenes))
        results = run_seeds(
            archive, settings, seeds, executor, lambda done, total: progress.update(task, completed=done, total=total)
        )
    document = study_document(archive, settings, results, executor.workers, network_records(settings.models))
    print_evaluation(make_console(), document, by_width=by_width)
    if out is not None:
        write_document(out, document)
        typer.echo(f"wrote {out}")
    if picture is not None:
        _draw(document, picture, marked)


def _check_outputs(out: Path | None, picture: Path | None, trained_widths: str | None) -> tuple[float, ...]:
    """Refuse early what could not be written; the widths to mark."""
    for option, path, suffix in (("--out", out, ".json"), ("--picture", picture, ".png")):
        if path is not None:
            if path.suffix != suffix:
                raise InvalidInputError(f"{option} must end in {suffix}, got '{path.name}'")
            make_folder(path, option)
    if picture is not None:
        with needs("evaluate --picture", "data"):
            import regnet_core.evaluation.curves  # noqa: F401
    if trained_widths is None:
        return ()
    if picture is None:
        raise InvalidInputError("--trained-widths says what to mark: it needs --picture FILE.png")
    try:
        return tuple(float(width) for width in trained_widths.split(","))
    except ValueError:
        raise InvalidInputError(
            f"--trained-widths takes metres with commas between, such as 0.06,0.08, got {trained_widths!r}"
        ) from None


def _methods(models: list[str]) -> tuple[str, ...]:
    """With the methods of the main table for "all"."""
    from regnet_core.evaluation.methods import ALL, main_table

    if ALL not in models:
        return tuple(models)
    ready, missing = main_table()
    if missing:
        typer.echo(f"without weights, and left out: {', '.join(missing)}", err=True)
    return (*ready, *(model for model in models if model != ALL and model not in ready))


def _first(archive: SceneArchive, count: int | None) -> tuple[int, ...]:
    if not len(archive):
        raise InvalidInputError(f"'{archive.folder}' has no finished shard of scenes yet")
    if count is not None and not 1 <= count <= len(archive):
        raise InvalidInputError(f"--scenes must be 1 to {len(archive)} for this data set, got {count}")
    return archive.indices[:count]


def _all_views(views: str) -> bool:
    if views not in ("one", "all"):
        raise InvalidInputError(f"--views must be one or all, got {views!r}")
    return views == "all"


def _draw(document: Mapping[str, Any], path: Path, trained_widths: Sequence[float]) -> None:
    from regnet_core.evaluation.bars import draw_bars
    from regnet_core.evaluation.curves import draw_curves

    if len(document["settings"]["widths"]) > 1:
        draw_curves(document, path, trained_widths)
    else:
        draw_bars(document, path)
    typer.echo(f"wrote {path}")


def _bar(quiet: bool) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
        disable=quiet,
    )
