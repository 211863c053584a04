"""``regnet train``: trains a network on a data set."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from regnet_core.cli.needs import needs
from regnet_core.errors import InvalidInputError

if TYPE_CHECKING:  # torch is not there for every command
    from regnet_core.training.trainer import Report, Trainer

_RECIPE, _RUN = "Recipe", "Run"


def train(
    config: Annotated[str, typer.Option(help="Network, such as regnetv2-s or regnetv2-s-layer2.")],
    data: Annotated[Path, typer.Option(help="Data set to train on, made by `regnet generate`.")],
    out: Annotated[Path, typer.Option(help="Folder of the checkpoint and the log.")],
    validation: Annotated[Path | None, typer.Option(help="Data set to validate on.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
    start: Annotated[
        Path | None, typer.Option(help="Weights to start from, of another run.", rich_help_panel=_RECIPE)
    ] = None,
    steps: Annotated[int, typer.Option(help="Batches in all.", rich_help_panel=_RECIPE)] = 20_000,
    batch: Annotated[int, typer.Option(help="Views in a batch.", rich_help_panel=_RECIPE)] = 6,
    points: Annotated[
        int | None,
        typer.Option(help="Points of a view.", show_default="what the network is made for", rich_help_panel=_RECIPE),
    ] = None,
    learning_rate: Annotated[float, typer.Option(help="The highest.", rich_help_panel=_RECIPE)] = 2e-3,
    seed: Annotated[int, typer.Option(help="Of every random choice.", rich_help_panel=_RECIPE)] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda.", rich_help_panel=_RUN)] = "auto",
    workers: Annotated[int, typer.Option(help="Processes that read data.", rich_help_panel=_RUN)] = 1,
    stop_after: Annotated[
        float, typer.Option(help="Save and stop after so many minutes.", rich_help_panel=_RUN)
    ] = math.inf,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar.")] = False,
) -> None:
    """Train a network; the run goes on with --resume, and is repeated by the same options.

    Every number of every step is a line of log.jsonl in --out, and a curve in TensorBoard where that is installed:
    tensorboard --logdir OUT. On several GPUs: torchrun --nproc-per-node 4 -m regnet_core.cli train ...
    """
    # Threads that spin while they wait make everything several times slower when another process wants the cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with needs("train", "train"):
        import torch

        from regnet_core.nn.zoo import network_config
        from regnet_core.training.distributed import join_group, leave_group
        from regnet_core.training.memory import keep_memory
        from regnet_core.training.recipe import Recipe
        from regnet_core.training.trainer import Run, Trainer
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cpu":
        keep_memory()
    points = points or network_config(config).points
    recipe = Recipe(steps=steps, batch=batch, points=points, learning_rate=learning_rate, seed=seed)
    group, device = join_group(device)
    run = Run(config, data, out, validation, device, workers, stop_after=60.0 * stop_after, group=group, start=start)
    trainer = Trainer(run, recipe)
    if trainer.checkpoint.exists() and not resume:
        raise InvalidInputError(f"'{out}' holds a checkpoint: give --resume to go on, or another folder")
    if resume:
        trainer.resume()
    if group.leads:
        _train(trainer, out, quiet)
    else:
        trainer.train()
    leave_group()


def _train(trainer: Trainer, out: Path, quiet: bool) -> None:
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
