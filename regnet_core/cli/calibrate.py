"""``regnet calibrate``: the constants of the analytic policy for a robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from regnet_core.cli.needs import needs
from regnet_core.cli.results import make_folder
from regnet_core.cli.tables import make_console
from regnet_core.errors import InvalidInputError
from regnet_core.gripper import Gripper
from regnet_core.models import DEFAULT_MODEL
from regnet_core.policies import CONSTANTS, load_policy, save_policy
from regnet_core.robots.names import ROBOT_NAMES

if TYPE_CHECKING:
    from regnet_core.robots.calibration import Calibration

_REACH, _GRASP, _OUTPUT = "P(reach)", "P(grasp | reach)", "Output"


def calibrate(
    out: Annotated[Path, typer.Option(help="Write the policy to this .yaml.", rich_help_panel=_OUTPUT)],
    robot: Annotated[str, typer.Option(help=f"One of {', '.join(ROBOT_NAMES)}.")] = "baxter",
    samples: Annotated[
        int, typer.Option(help="Poses for which inverse kinematics is solved.", rich_help_panel=_REACH)
    ] = 20000,
    grasps: Annotated[int, typer.Option(help="Grasps that are executed in physics.", rich_help_panel=_GRASP)] = 400,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Data set whose scenes they are executed in.",
            show_default="scenes made on the spot",
            rich_help_panel=_GRASP,
        ),
    ] = None,
    model: Annotated[
        str, typer.Option(help="What detects them: one of `regnet models`, or a .safetensors.", rich_help_panel=_GRASP)
    ] = DEFAULT_MODEL,
    quality: Annotated[
        str,
        typer.Option(
            help="The s_q to fit over: that of the detector, or the antipodal score on the true meshes.",
            metavar="predicted|true",
            rich_help_panel=_GRASP,
        ),
    ] = "predicted",
    width: Annotated[
        float, typer.Option("--gripper-width", "-w", help="Largest opening between the fingers, in metres.")
    ] = Gripper().width,
    seed: Annotated[int, typer.Option(min=0, help="Of poses, scenes and grasps.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes, each with one core; 0: one for each core.")] = 0,
    device: Annotated[
        str, typer.Option(help="Where networks run: auto, cpu, cuda or cuda:N.", rich_help_panel=_GRASP)
    ] = "auto",
    picture: Annotated[
        Path | None, typer.Option(help="Draw both curves beside the paper's: .png.", rich_help_panel=_OUTPUT)
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bars.", rich_help_panel=_OUTPUT)] = False,
) -> None:
    """Repeat the paper's calibration of the selection policy for a robot.

    Poses are drawn over its table, and P(reach) is fitted to those that inverse kinematics reaches; detected grasps are
    executed in physics, and P(grasp | reach) is fitted to those that hold. The same command gives the same constants.
    """
    with needs("calibrate", "robots"):
        from regnet_core.data.generation.executors import LocalExecutor
        from regnet_core.data.storage.archive import SceneArchive
        from regnet_core.robots import calibration
        from regnet_core.robots.reach import ReachSettings, sample_reach
        from regnet_core.robots.trials import QUALITIES, DataSetScenes, MadeScenes, TrialSettings, execute_grasps
    _check_outputs(out, picture)
    if quality not in QUALITIES:
        raise InvalidInputError(f"--quality must be {' or '.join(QUALITIES)}, got {quality!r}")
    gripper = Gripper(width=width)
    reach = ReachSettings(robot, samples, seed, gripper)
    scenes = MadeScenes(seed) if data is None else DataSetScenes(SceneArchive(data), seed)
    trials = TrialSettings(scenes, grasps, model=model, device=device, gripper=gripper, seed=seed)
    executor = LocalExecutor(workers)
    with _bar(quiet) as progress:
        poses = progress.add_task("reaching", total=samples)
        tried = progress.add_task("grasping", total=grasps)
        reached = sample_reach(reach, executor, lambda done, _: progress.update(poses, completed=done))
        executed = execute_grasps(trials, executor, lambda done, _: progress.update(tried, completed=done))
    result = calibration.calibrate(reach, trials, reached, executed, quality)
    _print(result)
    save_policy(out, result.file)
    typer.echo(f"wrote {out}")
    if picture is not None:
        from regnet_core.robots.pictures import draw_calibration

        draw_calibration(result, picture)
        typer.echo(f"wrote {picture}")


def _check_outputs(out: Path, picture: Path | None) -> None:
    """Refuse early what could not be written."""
    for option, path, suffix in (("--out", out, ".yaml"), ("--picture", picture, ".png")):
        if path is not None:
            if path.suffix != suffix:
                raise InvalidInputError(f"{option} must end in {suffix}, got '{path.name}'")
            make_folder(path, option)
    if picture is not None:
        with needs("calibrate --picture", "robots"):
            import regnet_core.robots.pictures  # noqa: F401


def _print(result: Calibration) -> None:
    """The constants beside the paper's, and what was counted."""
    console = make_console()
    counts = ", ".join(f"{count} {outcome}" for outcome, count in result.reach_samples.counts.items())
    console.print(f"poses: {counts}", soft_wrap=True)
    console.print(f"grasps: {int(result.trials.held.sum())} of {len(result.trials.held)} held", soft_wrap=True)
    file, paper = result.file, load_policy("paper").policy
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="bold")
    for name in ("constant", result.robot, "standard error", "paper"):
        table.add_column(name, justify="left" if name == "constant" else "right")
    for name in CONSTANTS:
        table.add_row(
            name, f"{getattr(file.policy, name):.4f}", f"{file.errors[name]:.4f}", f"{getattr(paper, name):.4f}"
        )
    console.print(table)


def _bar(quiet: bool) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
        disable=quiet,
    )
