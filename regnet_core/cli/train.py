"""``regnet train``: trains a network, or a learned baseline, on a data set."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from regnet_core.baselines import LEARNED
from regnet_core.cli.needs import needs
from regnet_core.errors import InvalidInputError

if TYPE_CHECKING:  # torch is not there for every command
    from regnet_core.baselines.training import BaselineTrainer
    from regnet_core.training.trainer import Report, Trainer

_RECIPE, _RUN = "Recipe", "Run"


def train(
    config: Annotated[
        str, typer.Option(help=f"Network, such as regnetv2-s or regnetv2-s-layer2, or baseline: {', '.join(LEARNED)}.")
    ],
    data: Annotated[Path, typer.Option(help="Data set to train on, made by `regnet generate`.")],
    out: Annotated[Path, typer.Option(help="Folder of the checkpoint and the log.")],
    validation: Annotated[Path | None, typer.Option(help="Data set to validate on.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
    start: Annotated[
        Path | None, typer.Option(help="Weights to start from, of another run.", rich_help_panel=_RECIPE)
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(help="Batches in all.", show_default="20000; a baseline's own", rich_help_panel=_RECIPE),
    ] = None,
    batch: Annotated[
        int | None,
        typer.Option(
            help="Views in a batch; hands, for a baseline that classifies them.",
            show_default="6; a baseline's own",
            rich_help_panel=_RECIPE,
        ),
    ] = None,
    gripper_width: Annotated[
        list[float] | None,
        typer.Option(
            "--gripper-width",
            "-w",
            help="Only for this width of the data set's, in metres; give it several times.",
            show_default="all of them, and others between; a baseline's own",
            rich_help_panel=_RECIPE,
        ),
    ] = None,
    points: Annotated[
        int | None,
        typer.Option(help="Points of a view.", show_default="what the network is made for", rich_help_panel=_RECIPE),
    ] = None,
    detail: Annotated[
        float | None,
        typer.Option(
            help="Share of the network's centroids and of their neighbours: with less of them, and of the points, "
            "steps are faster; a run of the whole network can --start from that.",
            show_default="1",
            rich_help_panel=_RECIPE,
        ),
    ] = None,
    learning_rate: Annotated[
        float | None, typer.Option(help="The highest.", show_default="0.002; a baseline's own", rich_help_panel=_RECIPE)
    ] = None,
    examples: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the judged hands that gpd-3, gpd-12 and pointnetgpd learn from; it serves all of them.",
            show_default="examples in --out",
            rich_help_panel=_RECIPE,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of every random choice.", rich_help_panel=_RECIPE)] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda.", rich_help_panel=_RUN)] = "auto",
    workers: Annotated[int, typer.Option(help="Processes that read data or make examples.", rich_help_panel=_RUN)] = 1,
    stop_after: Annotated[
        float, typer.Option(help="Save and stop after so many minutes.", rich_help_panel=_RUN)
    ] = math.inf,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.")] = False,
) -> None:
    """Train a network or a learned baseline; --resume goes on, and the same options repeat the run.

    Every number of every step is a line of log.jsonl in --out, and a curve in TensorBoard where that is installed:
    tensorboard --logdir OUT. On several GPUs: torchrun --nproc-per-node 4 -m regnet_core.cli train ...
    """
    # Threads that spin while they wait make everything several times slower when another process wants the cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with needs("train", "train"):
        import torch
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    changes = {"steps": steps, "batch": batch, "learning_rate": learning_rate, "seed": seed}
    recipe = {name: value for name, value in changes.items() if value is not None}
    where: dict[str, Any] = {"data": data, "out": out, "validation": validation, "workers": workers}
    where["stop_after"] = 60.0 * stop_after
    if config in LEARNED:
        if start is not None:
            raise InvalidInputError(f"--start is for networks; '{config}' starts from random weights")
        if detail is not None:
            raise InvalidInputError(f"--detail is for networks; '{config}' has sizes of its own")
        if gripper_width:
            raise InvalidInputError(f"--gripper-width is for networks; '{config}' has a width of its own")
        _train_baseline(
            config, where | {"points": points, "examples": examples, "device": device}, recipe, resume, quiet
        )
    else:
        if examples is not None:
            raise InvalidInputError(f"--examples is for baselines that classify hands; '{config}' is none")
        own: dict[str, Any] = {"points": points, "widths": tuple(gripper_width or ())}
        if detail is not None:
            own["detail"] = detail
        _train_network(config, where | {"start": start}, recipe | own, device, resume, quiet)


def _train_network(
    config: str, where: dict[str, Any], recipe: dict[str, Any], device: str, resume: bool, quiet: bool
) -> None:
    with needs("train", "train"):
        from regnet_core.memory import keep_freed_memory
        from regnet_core.nn.zoo import network_config
        from regnet_core.training.distributed import join_group, leave_group
        from regnet_core.training.recipe import Recipe
        from regnet_core.training.trainer import Run, Trainer
    if device == "cpu":
        keep_freed_memory()
    recipe["points"] = recipe["points"] or network_config(config).points
    group, device = join_group(device)
    trainer = Trainer(Run(config, device=device, group=group, **where), Recipe(**recipe))
    _begin(trainer, where["out"], resume)
    if group.leads:
        _train(trainer, where["out"], quiet)
    else:
        trainer.train()
    leave_group()


def _train_baseline(config: str, where: dict[str, Any], recipe: dict[str, Any], resume: bool, quiet: bool) -> None:
    with needs("train", "train"):
        from regnet_core.baselines.runs import BaselineRun, prepare, recipe_of
    with _bar(quiet) as progress:
        task = progress.add_task("examples", total=None, loss="")
        trainer = prepare(
            BaselineRun(config, **where),
            recipe_of(config, **recipe),
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    _begin(trainer, where["out"], resume)
    _train(trainer, where["out"], quiet)


def _begin(trainer: Trainer | BaselineTrainer, out: Path, resume: bool) -> None:
    """Go on with the run that is in the folder, or see that there is none."""
    if trainer.checkpoint.exists() and not resume:
        raise InvalidInputError(f"'{out}' holds a checkpoint: give --resume to go on, or another folder")
    if resume:
        trainer.resume()


def _train(trainer: Trainer | BaselineTrainer, out: Path, quiet: bool) -> None:
    """Train with a log, curves and a progress bar."""
    out.mkdir(parents=True, exist_ok=True)
    steps = trainer.recipe.steps
    with open(out / "log.jsonl", "a", encoding="utf-8") as log, _curves(out) as draw, _bar(quiet) as progress:
        task = progress.add_task("training", total=steps, completed=trainer.step, loss="")

        def report(step: int, values: dict[str, float]) -> None:
            log.write(json.dumps({"step": step, **values}) + "\n")
            log.flush()
            draw(step, values)
            progress.update(task, completed=step)
            if "total" in values:
                progress.update(task, loss=f"loss {values['total']:.3f}")

        trainer.report = report
        trainer.train()
    if not quiet:
        typer.echo(f"{trainer.step} of {steps} steps done: {trainer.checkpoint}")


@contextmanager
def _curves(out: Path) -> Iterator[Report]:
    """Draws numbers in TensorBoard, where it is installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        yield lambda step, values: None
        return
    with SummaryWriter(str(out)) as writer:

        def draw(step: int, values: dict[str, float]) -> None:
            for name, value in values.items():
                writer.add_scalar(name, value, step)

        yield draw


def _bar(quiet: bool) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[loss]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
        disable=quiet,
    )
