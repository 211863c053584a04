"""Any methods on any scenes of a data set with any grippers, all judged alike, on all cores.

What a scene's results are depends on the scene and the settings alone, whatever worker judges it; only times differ.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import PurePath
from typing import NamedTuple

from regnet_core.checks import check_range
from regnet_core.data.generation.executors import Executor
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.detector import DetectorConfig, GraspDetector
from regnet_core.errors import InvalidInputError, RegnetError
from regnet_core.evaluation.execution import Execution
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.evaluation.metrics import MetricConfig, SceneMetrics, evaluate_scene
from regnet_core.evaluation.observed import CloudSource, ObservedCloud, RecordedViews
from regnet_core.gripper import Gripper
from regnet_core.models import is_weights_path
from regnet_core.ops.parallel import available_cores
from regnet_core.report import DetectionReport
from regnet_core.weights import network_names

Progress = Callable[[int, int], None]
"""Called with the number of scenes that are done and of all."""


class EvaluationError(RegnetError):
    """A scene could not be judged; the message names it."""


@dataclass(frozen=True)
class StudySettings:
    """What is compared, and how.

    Raises:
        InvalidInputError: there is nothing to compare, or something is given twice.
    """

    models: tuple[str, ...]
    """As ``GraspDetector`` takes them."""
    widths: tuple[float, ...]
    """Gripper widths W [m]; the data set has labels for each."""
    scenes: tuple[int, ...]
    """Numbers of the scenes."""
    all_views: bool = False
    """Whether every view of a scene is judged; otherwise one, that of the scene's number modulo the number of views."""
    clouds: CloudSource = field(default_factory=RecordedViews)
    """What the methods see; as many views as the data set has."""
    seed: int = 0
    """Of the detectors."""
    device: str = "auto"
    """Where networks run."""
    simulate: bool = False
    """Whether the best grasp of each detection is executed in physics."""
    metrics: MetricConfig = field(default_factory=MetricConfig)

    def __post_init__(self) -> None:
        for name in ("models", "widths", "scenes"):
            values = getattr(self, name)
            if not values:
                raise InvalidInputError(f"an evaluation needs at least one of the {name}")
            twice = sorted({str(value) for value in values if values.count(value) > 1})
            if twice:
                raise InvalidInputError(f"{name} must differ from each other, got {', '.join(twice)} more than once")

    def check(self, archive: SceneArchive) -> None:
        """Refuse early what a worker would find out.

        Raises:
            InvalidInputError: the data set lacks a scene or a width, or there is no such model or device.
        """
        unknown = sorted(set(self.scenes) - set(archive.indices))
        if unknown:
            raise InvalidInputError(f"'{archive.folder}' has {len(archive)} scenes, and none numbered {unknown[:5]}")
        there = ", ".join(map(str, archive.widths))
        for width in self.widths:
            if width not in archive.widths:
                raise InvalidInputError(f"'{archive.folder}' has labels for the widths {there} m, not for {width:g}")
        for model in self.models:
            GraspDetector(model, device_of(model, self.device), self.seed)


class Times(NamedTuple):
    """Of one detection [s], or means of several."""

    proposals: float
    """The method itself: the forward pass of a network, or the sampling of a baseline."""
    total: float
    """From cloud to ranked grasps."""

    @property
    def processing(self) -> float:
        """Everything but the method itself: preparation, filters, collision, ranking."""
        return self.total - self.proposals

    @classmethod
    def of(cls, report: DetectionReport) -> Times:
        """The times of a detection, which may have ended before it came to proposals."""
        return cls(sum(step.seconds for step in report.steps if step.name == "proposals"), report.total_seconds)


@dataclass(frozen=True)
class ViewResult:
    """One method on one view of a scene with one gripper."""

    model: str
    """One of ``model_labels``."""
    scene: int
    view: int
    kind: str
    """Kind of the scene."""
    metrics: SceneMetrics
    times: Times
    outcome: str | None = None
    """How the best grasp ended in physics (``Execution.outcome``); None where it was not to be tried."""
    seed: int = 0
    """Of the clouds and the methods."""


def run_study(
    archive: SceneArchive, settings: StudySettings, executor: Executor, progress: Progress = lambda done, total: None
) -> list[ViewResult]:
    """Judge all methods; results are ordered by scene, view, width and method.

    Raises:
        InvalidInputError: something that was asked for is not there.
        EvaluationError: a scene could not be judged.
    """
    settings.check(archive)
    results: dict[int, list[ViewResult]] = {}
    progress(0, len(settings.scenes))
    for scene, found in executor.run(judge_scene, (archive, settings), settings.scenes):
        results[scene] = found
        progress(len(results), len(settings.scenes))
    return [result for scene in settings.scenes for result in results[scene]]


def run_seeds(
    archive: SceneArchive,
    settings: StudySettings,
    seeds: int,
    executor: Executor,
    progress: Progress = lambda done, total: None,
) -> list[ViewResult]:
    """The study so many times, with the settings' seed and those that follow it: other points of the same views, and
    other random choices of the methods. Results are ordered by seed, then as those of ``run_study``.

    Raises:
        InvalidInputError: something that was asked for is not there.
        EvaluationError: a scene could not be judged.
    """
    check_range("seeds", seeds, 1, 1000)
    each, results = len(settings.scenes), list[ViewResult]()
    # All of them before the first runs, which may take an hour: a seed that is too large is refused here.
    every = [
        replace(settings, seed=seed, clouds=settings.clouds.seeded(seed))
        for seed in range(settings.seed, settings.seed + seeds)
    ]
    for number, own in enumerate(every):

        def shown(done: int, total: int, before: int = number * each) -> None:
            progress(before + done, seeds * each)

        results += run_study(archive, own, executor, shown)
    return results


def judge_scene(shared: tuple[SceneArchive, StudySettings], scene: int) -> list[ViewResult]:
    """All methods on one scene.

    Raises:
        EvaluationError: it could not be judged; the message names it.
    """
    archive, settings = shared
    with naming_the_scene(archive, scene):
        return _judge_scene(archive, settings, scene)


@contextmanager
def naming_the_scene(archive: SceneArchive, scene: int) -> Iterator[None]:
    """Any error inside becomes an EvaluationError that says which scene it was."""
    try:
        yield
    except Exception as error:
        what = str(error) if isinstance(error, RegnetError) else f"{type(error).__name__}: {error}"
        raise EvaluationError(f"scene {scene} of '{archive.folder}' cannot be judged: {what}") from error


def views_of(settings: StudySettings, scene: int, views: int) -> Sequence[int]:
    """Which of its views are judged."""
    return range(views) if settings.all_views else (scene % views,)


def device_of(model: str, device: str) -> str:
    """The device that was asked for where the model is a network; baselines run on the CPU only."""
    return device if is_weights_path(model) or model in network_names() else "auto"


def limit_torch() -> None:
    """Let torch, where a model has loaded it, use as many cores as this process may, not all of the machine."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(available_cores())


def model_labels(models: Sequence[str]) -> dict[str, str]:
    """A short name for each model: its own, or as much of the end of a file's path as tells it from the others.

    The file ``weights.safetensors``, which every training leaves, is called by its folder.
    """
    every = {model: _parts(model) for model in models}
    labels = {}
    for model, parts in every.items():
        others, length = [other for key, other in every.items() if key != model], 1
        while length < len(parts) and any(other[-length:] == parts[-length:] for other in others):
            length += 1
        labels[model] = "/".join(parts[-length:])
    return labels


def _parts(model: str) -> tuple[str, ...]:
    if not is_weights_path(model):
        return (model,)
    parts = PurePath(model).with_suffix("").parts
    return parts[:-1] if parts[-1] == "weights" and len(parts) > 1 else parts


def _judge_scene(archive: SceneArchive, settings: StudySettings, index: int) -> list[ViewResult]:
    info, labels, scene = archive.info(index), archive.labels(index), archive.scene(index)
    truth = GroundTruth(scene.world_meshes(), scene.table, fixtures=scene.fixtures)
    execution = Execution(scene, truth) if settings.simulate else None
    names, results = model_labels(settings.models), []
    for view in views_of(settings, index, len(info.views)):
        cloud = settings.clouds(archive, index, view)
        for width in settings.widths:
            gripper, wanted = Gripper(width=width), labels[archive.widths.index(width)]
            for model in settings.models:
                detection = _detector(settings, model, cloud).detect(cloud.points, gripper, viewpoint=cloud.viewpoint)
                grasps = detection.grasps
                metrics = evaluate_scene(
                    grasps, gripper, cloud.points, truth, wanted, plane=cloud.plane, config=settings.metrics
                )
                outcome = execution.outcome(grasps, gripper, len(wanted)) if execution else None
                times = Times.of(detection.report)
                results.append(ViewResult(names[model], index, view, info.kind, metrics, times, outcome, settings.seed))
    return results


_detectors: dict[tuple[str, str, int, int], GraspDetector] = {}
"""Of this process, ready to run."""


def _detector(settings: StudySettings, model: str, cloud: ObservedCloud) -> GraspDetector:
    """A detector that has run before, so that its times are not those of compiling and loading."""
    key = (model, settings.device, settings.seed, settings.metrics.checked)
    if key not in _detectors:
        config = DetectorConfig(max_grasps=settings.metrics.checked)
        detector = GraspDetector(model, device_of(model, settings.device), settings.seed, config)
        limit_torch()
        detector.detect(cloud.points, Gripper(width=settings.widths[0]), viewpoint=cloud.viewpoint)
        _detectors[key] = detector
    return _detectors[key]
