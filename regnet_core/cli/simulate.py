"""``regnet simulate``: bin picking in physics, by any methods."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from regnet_core.cli.needs import needs
from regnet_core.cli.results import make_folder
from regnet_core.cli.simulation_tables import markdown, print_attempts, print_simulation
from regnet_core.cli.tables import make_console
from regnet_core.errors import InvalidInputError
from regnet_core.models import DEFAULT_MODEL

if TYPE_CHECKING:
    from regnet_core.data.generation.executors import Executor
    from regnet_core.picking.study import PickSettings

_WHAT, _HOW, _CELL, _OUTPUT = "What to compare", "How", "What the integrator sets", "Output"


def simulate(
    out: Annotated[Path, typer.Option(help="Folder of the results; a study that is begun there goes on.")],
    scene: Annotated[
        list[str] | None,
        typer.Option(
            help="easy-N, hard-N or mixed-N, N objects in a bin; pile-N or packed-N, on a table as VGN has them; give "
            "it several times.",
            show_default="easy-10, hard-10, mixed-20",
            rich_help_panel=_WHAT,
        ),
    ] = None,
    model: Annotated[
        list[str] | None,
        typer.Option(
            help="One of `regnet models`, or the path of a network's .safetensors; give it several times.",
            show_default=DEFAULT_MODEL,
            rich_help_panel=_WHAT,
        ),
    ] = None,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="heuristic or analytic; give it several times.", show_default="analytic", rich_help_panel=_WHAT
        ),
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            help="above, front or corner; give it several times.", show_default="front", rich_help_panel=_WHAT
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Of each combination.", rich_help_panel=_WHAT)] = 5,
    width: Annotated[
        float, typer.Option("--gripper-width", "-w", help="Width of the gripper in metres.", rich_help_panel=_HOW)
    ] = 0.08,
    sensor: Annotated[
        str, typer.Option(help="kinect_v2, kinect_v1 or realsense_d435.", rich_help_panel=_HOW)
    ] = "kinect_v2",
    seed: Annotated[int, typer.Option(help="Of objects, scenes, noise and methods.", rich_help_panel=_HOW)] = 0,
    device: Annotated[
        str, typer.Option(help="Where networks run: auto, cpu, cuda or cuda:N.", rich_help_panel=_HOW)
    ] = "auto",
    workers: Annotated[
        int, typer.Option(help="Processes, each with one core; 0: one for each core.", rich_help_panel=_HOW)
    ] = 0,
    max_tilt: Annotated[
        float, typer.Option(help="Largest angle of approaches from straight down, in degrees.", rich_help_panel=_CELL)
    ] = 60.0,
    min_quality: Annotated[
        float,
        typer.Option(help="Grasps of less quality, doubts included, are no grasps, 0 to 1.", rich_help_panel=_CELL),
    ] = 0.4,
    known_bin: Annotated[
        bool,
        typer.Option(
            "--known-bin/--unknown-bin", help="Leave out hands that would meet the bin.", rich_help_panel=_CELL
        ),
    ] = True,
    check_way: Annotated[
        bool,
        typer.Option(
            "--check-way/--no-check-way",
            help="Leave out hands that would meet points on their way in.",
            rich_help_panel=_CELL,
        ),
    ] = True,
    avoid: Annotated[
        float,
        typer.Option(help="Distance in metres from failed grasps that is avoided; 0: none.", rich_help_panel=_CELL),
    ] = 0.03,
    looks: Annotated[
        int, typer.Option(help="Clouds without a grasp in a row before there is none.", rich_help_panel=_CELL)
    ] = 3,
    watch: Annotated[
        str | None,
        typer.Option(
            help="Draw attempts of an episode, counted from 0: all of them, or one, such as 2:7. It needs one scene, "
            "model, policy and camera.",
            metavar="EPISODE[:ATTEMPT]",
            rich_help_panel=_OUTPUT,
        ),
    ] = None,
    film: Annotated[
        bool, typer.Option("--film", help="Write watched attempts as animated GIFs, too.", rich_help_panel=_OUTPUT)
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(help="Draw rates and failures: .png.", rich_help_panel=_OUTPUT)
    ] = None,
    as_markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the table as Markdown.", rich_help_panel=_OUTPUT)
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.", rich_help_panel=_OUTPUT)] = False,
) -> None:
    """Pick objects from a bin in physics: success rate, completion rate, and why attempts fail.

    A camera looks, the model detects, the policy selects, a free hand picks and places; success is one object in the
    place bin. Finished episodes stay in the folder: a run that was interrupted goes on where it was, and the same
    command gives the same results.
    """
    with needs("simulate", "data"):
        from regnet_core.data.generation.executors import LocalExecutor
        from regnet_core.picking.planner import PlanConfig
        from regnet_core.picking.scenes import BIN_SCENES
        from regnet_core.picking.study import PickSettings
    if picture is not None:
        if picture.suffix != ".png":
            raise InvalidInputError(f"--picture must end in .png, got '{picture.name}'")
        make_folder(picture, "--picture")
    if film and watch is None:
        raise InvalidInputError("--film says how to draw: it needs --watch EPISODE[:ATTEMPT]")
    settings = PickSettings(
        scenes=tuple(scene or BIN_SCENES),
        models=tuple(model or (DEFAULT_MODEL,)),
        policies=tuple(policy or ("analytic",)),
        cameras=tuple(camera or ("front",)),
        episodes=episodes,
        width=width,
        sensor=sensor,
        seed=seed,
        device=device,
        plan=PlanConfig(
            max_tilt=math.radians(max_tilt),
            min_quality=min_quality,
            known_bin=known_bin,
            check_way=check_way,
            avoid=avoid,
            looks=looks,
        ),
    )
    if watch is not None:
        _watch(settings, out, watch, film)
    else:
        _study(settings, out, LocalExecutor(workers), picture, as_markdown, quiet)


def _study(
    settings: PickSettings, out: Path, executor: Executor, picture: Path | None, as_markdown: bool, quiet: bool
) -> None:
    """Run what is missing, print the rates and write them."""
    import json

    from regnet_core.data.storage.tars import write_whole
    from regnet_core.picking.document import study_document
    from regnet_core.picking.study import run_study

    with _bar(quiet) as progress:
        task = progress.add_task("picking", total=len(settings.jobs))
        records = run_study(
            out, settings, executor, lambda done, total: progress.update(task, completed=done, total=total)
        )
    document = study_document(settings, records)
    write_whole(out / "study.json", (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    if as_markdown:
        typer.echo(markdown(document))
    else:
        print_simulation(make_console(), document)
        typer.echo(f"wrote {out / 'study.json'}")
    if picture is not None:
        from regnet_core.picking.chart import draw_chart

        draw_chart(document, picture)
        if not as_markdown:
            typer.echo(f"wrote {picture}")


def _watch(settings: PickSettings, out: Path, which: str, film: bool) -> None:
    """Draw attempts of an episode, which is run first if it is not there."""
    from PIL import Image

    from regnet_core.picking.study import EpisodeStore, Job, only_cell, run_episode
    from regnet_core.picking.watch import strip, watch, write_film

    episode, number = _parse_watch(which)
    job = Job(only_cell(settings), episode)
    store = EpisodeStore(out, settings)
    if not store.path(job).is_file():
        store.write(job, run_episode(settings, job))
    record = store.read(job)
    print_attempts(make_console(), record)
    for chosen in range(len(record["attempts"])) if number is None else (number,):
        watched = watch(settings, out, job, chosen)
        path = out / "watched" / f"{store.path(job).parent.name}-{episode:03d}-{chosen:02d}.png"
        make_folder(path, "--out")
        Image.fromarray(strip(watched)).save(path)
        typer.echo(f"wrote {path}")
        if film:
            write_film(path.with_suffix(".gif"), watched)
            typer.echo(f"wrote {path.with_suffix('.gif')}")


def _parse_watch(which: str) -> tuple[int, int | None]:
    episode, colon, attempt = which.partition(":")
    if not episode.isdecimal() or (colon and not attempt.isdecimal()):
        raise InvalidInputError(f"--watch takes EPISODE or EPISODE:ATTEMPT, counted from 0, such as 2:7, got {which!r}")
    return int(episode), int(attempt) if colon else None


def _bar(quiet: bool) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
        disable=quiet,
    )
