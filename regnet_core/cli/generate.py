"""``regnet generate``: makes a data set of scenes, views and grasp labels."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from regnet_core.cli.needs import needs
from regnet_core.errors import InvalidInputError

_WHAT, _FROM, _WHERE = "What to make", "Objects", "Where to compute"
_DEFAULT_WIDTHS = (0.06, 0.08, 0.10, 0.12)


def generate(
    out: Annotated[Path, typer.Option("--out", help="Folder of the data set; an unfinished one is continued.")],
    scenes: Annotated[int, typer.Option(help="Number of scenes.", rich_help_panel=_WHAT)] = 1000,
    seed: Annotated[int, typer.Option(help="Of every random choice.", rich_help_panel=_WHAT)] = 0,
    split: Annotated[
        str, typer.Option(help="Objects of which split: train, val or test.", rich_help_panel=_WHAT)
    ] = "train",
    width: Annotated[
        list[float] | None,
        typer.Option(
            "--gripper-width",
            "-w",
            help="Width to label grasps for [m]; give it several times.",
            show_default="0.06, 0.08, 0.10 and 0.12",
            rich_help_panel=_WHAT,
        ),
    ] = None,
    kind: Annotated[
        list[str] | None,
        typer.Option(
            "--kind",
            help="Kind of scene, or kind=share: pile, single, packed, bin; give it several times.",
            show_default="pile=0.6, single=0.1, packed=0.15, bin=0.15",
            rich_help_panel=_WHAT,
        ),
    ] = None,
    paper_views: Annotated[
        int, typer.Option(help="Views of a scene from the paper's four poses.", rich_help_panel=_WHAT)
    ] = 2,
    dome_views: Annotated[
        int, typer.Option(help="Views of a scene from random places by random sensors.", rich_help_panel=_WHAT)
    ] = 2,
    library: Annotated[
        int | None,
        typer.Option(
            help="Number of procedural objects.",
            show_default="200 for train, 50 for val and test",
            rich_help_panel=_FROM,
        ),
    ] = None,
    objects: Annotated[
        Path | None,
        typer.Option(help="Folder of meshes (.obj .ply .stl .glb .off) to use instead.", rich_help_panel=_FROM),
    ] = None,
    objects_scale: Annotated[
        float | None,
        typer.Option(help="Factor from the meshes' unit to metres.", show_default="1", rich_help_panel=_FROM),
    ] = None,
    workers: Annotated[
        int, typer.Option(help="Processes on this machine; 0: one for each core.", rich_help_panel=_WHERE)
    ] = 0,
    ray: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Compute on this Ray cluster (needs Ray).", rich_help_panel=_WHERE),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.")] = False,
) -> None:
    """Make a data set: scenes dropped in physics, seen by noisy depth cameras, with labelled grasps.

    The same settings give the same bytes, whatever the number of workers. A run that was interrupted goes on when the
    same command is given again; with more --scenes a finished data set grows.
    """
    with needs("generate", "data"):
        from regnet_core.data.generation.executors import LocalExecutor, RayExecutor
        from regnet_core.data.generation.run import generate as run
        from regnet_core.data.generation.settings import KIND_SHARES, GenerationSettings
    widths = tuple(width or _DEFAULT_WIDTHS)
    if objects is not None and library is not None:
        raise InvalidInputError("--objects takes the place of the procedural library: leave out --library")
    if objects is None and objects_scale is not None:
        raise InvalidInputError("--objects-scale is for your own meshes: it needs --objects DIR")
    models = _import(objects, objects_scale or 1.0, max(widths)) if objects is not None else ()
    settings = GenerationSettings(
        seed=seed,
        split=split,
        scenes=scenes,
        widths=widths,
        kinds=tuple(_kinds(kind).items()) if kind else tuple(KIND_SHARES.items()),
        paper_views=paper_views,
        dome_views=dome_views,
        objects=len(models) or library or 0,
        meshes=_digest(models),
    )
    executor = LocalExecutor(workers) if ray is None else RayExecutor(ray)
    try:
        with _Bars(quiet) as bars:
            manifest = run(out, settings, executor, models=models, progress=bars.show)
    except KeyboardInterrupt:
        typer.echo(f"regnet: what is done is kept in '{out}'; the same command goes on from there", err=True)
        raise
    if not quiet:
        size = sum(path.stat().st_size for path in (out / "shards").iterdir())
        typer.echo(
            f"{settings.scenes} scenes, {settings.scenes * settings.views} views, {len(manifest.objects)} objects in "
            f"{len(manifest.shards)} shards of {size / 1e6:.0f} MB together: {out}"
        )


def _kinds(options: list[str]) -> dict[str, float]:
    """Shares of the kinds from options such as "pile" or "bin=0.3"."""
    shares = {}
    for option in options:
        name, _, share = option.partition("=")
        if name in shares:
            raise InvalidInputError(f"--kind {name} is given twice")
        try:
            shares[name] = float(share) if share else 1.0
        except ValueError:
            raise InvalidInputError(f"--kind takes KIND or KIND=SHARE, such as bin=0.3, got {option!r}") from None
    return shares


def _import(folder: Path, scale: float, widest: float) -> tuple[Any, ...]:
    """The user's meshes; what is refused is said, with the reason."""
    with needs("generate --objects", "data"):
        from regnet_core.data.objects.user_meshes import import_meshes
    result = import_meshes(folder, scale, widest)
    for refusal in result.refused:
        typer.echo(f"regnet: refused {refusal.path}: {refusal.reason}", err=True)
    if not result.accepted:
        raise InvalidInputError(f"none of the {len(result.refused)} mesh files below '{folder}' can be used")
    typer.echo(f"regnet: {len(result.accepted)} objects from '{folder}', {len(result.refused)} refused", err=True)
    return tuple(result.accepted)


def _digest(models: tuple[Any, ...]) -> str:
    """Of the user's meshes; empty for the procedural library."""
    if not models:
        return ""
    from regnet_core.data.objects.files import object_to_bytes

    digest = hashlib.sha256()
    for model in models:
        digest.update(object_to_bytes(model))
    return digest.hexdigest()


class _Bars:
    """A progress bar for each stage, with the rate and the time left."""

    def __init__(self, quiet: bool) -> None:
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=Console(stderr=True),
            disable=quiet,
            speed_estimate_period=120.0,
        )
        self._tasks: dict[str, Any] = {}

    def __enter__(self) -> _Bars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, stage: str, done: int, total: int) -> None:
        """What ``generation.generate`` calls."""
        if stage not in self._tasks:
            # What an earlier run did tells nothing about the rate of this one.
            self._tasks[stage] = self._progress.add_task(stage, total=total, completed=done, rate="")
        task = self._progress.tasks[self._progress.task_ids.index(self._tasks[stage])]
        speed = task.finished_speed or task.speed
        rate = f"{60.0 * speed:.0f}/min" if speed else ""
        self._progress.update(self._tasks[stage], completed=done, rate=rate)
