"""Sets up the training run of any learned baseline: its network, what it learns from, and the loop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch

from regnet_core.baselines.classification import GraspClassifier
from regnet_core.baselines.examples import Examples, ExampleSettings, Progress, make_examples
from regnet_core.baselines.s4g import WIDTH, S4gNetwork
from regnet_core.baselines.training import BaselineRecipe, BaselineTrainer, Lesson
from regnet_core.baselines.training_classifiers import ClassifierLesson
from regnet_core.baselines.training_s4g import S4gLesson
from regnet_core.baselines.zoo import method
from regnet_core.data.dataset import GraspDataset
from regnet_core.data.generation.executors import LocalExecutor
from regnet_core.data.storage.archive import SceneArchive


@dataclass(frozen=True)
class BaselineRun:
    """Where a run finds and leaves things.

    Attributes:
        name: of the method.
        data: folder of the training data.
        out: folder of checkpoint, weights and log.
        validation: folder of the validation data; none to go without.
        examples: folder of the judged candidates that classifiers learn from, made where they are not there yet; it
            serves all of them. None: "examples" in ``out``. Those of the validation data are in its "validation".
        settings: how examples are made.
        points: of a view, for S4G; None: as many as its network is made for.
        device: where to train.
        workers: processes that make examples or read data; 0: this one.
        stop_after: time after which to save and stop [s].
    """

    name: str
    data: Path
    out: Path
    validation: Path | None = None
    examples: Path | None = None
    settings: ExampleSettings = ExampleSettings()
    points: int | None = None
    device: str = "cpu"
    workers: int = 0
    stop_after: float = math.inf


def prepare(run: BaselineRun, recipe: BaselineRecipe, progress: Progress = lambda done, total: None) -> BaselineTrainer:
    """The trainer of a run; the examples of a classifier are made first, where they are not there yet.

    Args:
        run: where things are.
        recipe: how to train.
        progress: called as files of examples get done.

    Raises:
        ModelError: there is no such method.
        InvalidInputError: there is no such data, or it lacks what the method learns from.
    """
    chosen = method(run.name)
    with torch.random.fork_rng():
        torch.manual_seed(recipe.seed)
        network = chosen.network()
    lesson: Lesson
    if isinstance(network, S4gNetwork):
        lesson = _s4g(run, recipe, network)
    else:
        lesson = _classifier(run, recipe, cast(GraspClassifier, network), progress)
    return BaselineTrainer(run.name, lesson, recipe, run.out, stop_after=run.stop_after)


def recipe_of(name: str, seed: int = 0, **changes: Any) -> BaselineRecipe:
    """The usual recipe of a method; changes that are None leave it as it is.

    Raises:
        ModelError: there is no such method.
        InvalidInputError: a number is out of range.
    """
    usual = method(name)
    values = {"steps": usual.steps, "batch": usual.batch, "learning_rate": usual.learning_rate}
    values |= {key: value for key, value in changes.items() if value is not None}
    return BaselineRecipe(seed=seed, **values)  # type: ignore[arg-type]


def _classifier(
    run: BaselineRun, recipe: BaselineRecipe, network: GraspClassifier, progress: Progress
) -> ClassifierLesson:
    folder = run.examples or run.out / "examples"
    source = {"settings": SceneArchive(run.data).manifest.settings.to_dict(), "examples": run.settings.to_dict()}
    examples = _examples(run, run.data, folder, progress)
    validation = None
    if run.validation is not None:
        validation = _examples(run, run.validation, folder / "validation", progress)
    return ClassifierLesson(network, recipe, examples, source, validation, run.device)


def _examples(run: BaselineRun, data: Path, folder: Path, progress: Progress) -> Examples:
    executor = LocalExecutor(run.workers) if run.workers else None
    return make_examples(folder, SceneArchive(data), run.settings, executor, progress)


def _s4g(run: BaselineRun, recipe: BaselineRecipe, network: S4gNetwork) -> S4gLesson:
    points = run.points or network.config.backbone.points
    data = GraspDataset(run.data, points, widths=[WIDTH], seed=recipe.seed)
    validation = None if run.validation is None else GraspDataset(run.validation, points, widths=[WIDTH])
    return S4gLesson(network, recipe, data, validation, run.device, run.workers)
