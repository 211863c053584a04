"""How often grasps of a quality hold: a detector's grasps, executed by a free-flying hand in physics.

The hand is where the arm would have brought it, so what is counted is P(grasp | reach), the same for every robot with
the same gripper. Of each detection a few grasps are tried whose qualities are spread evenly over those it has: the
choice depends on nothing but the quality that the curve is fitted over, so it does not bend the curve.

Two qualities are known of each grasp: the one that the detector predicted, which a policy is given when it selects,
and the true antipodal score on the meshes, which the paper's s_q estimates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np

from regnet_core.checks import check_range
from regnet_core.data.cameras.dome import dome_camera
from regnet_core.data.cameras.rendering import TABLE_ID, SceneRenderer
from regnet_core.data.cameras.sensors import SENSORS
from regnet_core.data.generation.executors import Executor
from regnet_core.data.objects.library import build_object, library_specs
from regnet_core.data.objects.models import ObjectModel
from regnet_core.data.scenes.kinds import SCENE_KINDS, compose_scene, object_count
from regnet_core.data.scenes.scene import Scene
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.detector import DetectorConfig, GraspDetector
from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.execution import HELD, Execution
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.evaluation.observed import POINTS, ObservedCloud, RecordedViews, cropped_and_drawn
from regnet_core.evaluation.study import device_of, limit_torch
from regnet_core.geometry import Array, Plane
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.models import DEFAULT_MODEL
from regnet_core.sim.simulator import GraspSimulator

QUALITIES = ("predicted", "true")
_LIBRARY = 24
"""Objects that made scenes draw from, of the split that no network was trained on."""
_SENSOR = SENSORS["kinect_v2"]
_ROUNDS = 20
"""How many times as many scenes as are needed are looked at, at most, for detections with grasps."""


class SceneSource(Protocol):
    """Where scenes come from; it goes to other processes."""

    def __call__(self, index: int) -> tuple[Scene, ObservedCloud]:
        """Scene number ``index``, from 0, and what a camera saw of it; the same at each call."""
        ...

    def describe(self) -> str:
        """For a policy file."""
        ...


@dataclass(frozen=True)
class MadeScenes:
    """Scenes of all kinds in turn, made on the spot from a seed, each seen by one camera of the dome."""

    seed: int = 0

    def __call__(self, index: int) -> tuple[Scene, ObservedCloud]:
        rng = np.random.default_rng([self.seed, index])
        kind = SCENE_KINDS[index % len(SCENE_KINDS)]
        library = _library()
        count = min(object_count(kind, rng), len(library))
        scene = compose_scene(kind, [library[i] for i in rng.choice(len(library), count, replace=False)], rng)
        camera = dome_camera(rng, _SENSOR.intrinsics, scene.table)
        view = SceneRenderer(scene).render(camera, _SENSOR.noise, rng)
        points, pixels = view.cloud()
        chosen = cropped_and_drawn(points, view.object_ids.ravel()[pixels] > TABLE_ID, POINTS, rng)
        return scene, ObservedCloud(points[chosen], camera.position.copy(), Plane((0.0, 0.0, 1.0), scene.table_height))

    def describe(self) -> str:
        return f"made from seed {self.seed}"


@dataclass(frozen=True)
class DataSetScenes:
    """The scenes of a data set, again from the beginning after the last one, with other views each time."""

    archive: SceneArchive
    seed: int = 0

    def __call__(self, index: int) -> tuple[Scene, ObservedCloud]:
        number = self.archive.indices[index % len(self.archive)]
        view = (number + index // len(self.archive)) % len(self.archive.info(number).views)
        return self.archive.scene(number), RecordedViews(seed=self.seed)(self.archive, number, view)

    def describe(self) -> str:
        settings = self.archive.manifest.settings
        return f"data set of {len(self.archive)} scenes, split {settings.split}, seed {settings.seed}"


@dataclass(frozen=True)
class TrialSettings:
    """What is executed.

    Attributes:
        scenes: where they come from.
        grasps: how many are executed.
        per_scene: of one detection.
        model: what detects, as `GraspDetector` takes it.
        device: where it runs.
        gripper: that grasps.
        seed: of the detector and of the choice of grasps.

    Raises:
        InvalidInputError: a number is out of its range.
    """

    scenes: SceneSource = field(default_factory=MadeScenes)
    grasps: int = 400
    per_scene: int = 4
    model: str = DEFAULT_MODEL
    device: str = "auto"
    gripper: Gripper = field(default_factory=Gripper)
    seed: int = 0

    def __post_init__(self) -> None:
        check_range("grasps", self.grasps, 1, 10_000_000)
        check_range("per_scene", self.per_scene, 1, 1000)
        check_range("seed", self.seed, 0, 2**31 - 1)


class Trials(NamedTuple):
    """N executed grasps."""

    predicted: Array
    """(N,) s_q of the detector."""
    true: Array
    """(N,) antipodal score on the true meshes."""
    outcomes: tuple[str, ...]
    """Values of `sim.outcome.Outcome`."""

    @property
    def held(self) -> Array:
        """(N,) 1 where the object was held, else 0."""
        return np.array([float(outcome == HELD) for outcome in self.outcomes])

    def quality(self, which: str) -> Array:
        """(N,) the predicted or the true quality.

        Raises:
            InvalidInputError: it is neither.
        """
        if which not in QUALITIES:
            raise InvalidInputError(f"the quality is {' or '.join(QUALITIES)}, got {which!r}")
        return self.predicted if which == "predicted" else self.true


def execute_grasps(
    settings: TrialSettings, executor: Executor, progress: Callable[[int, int], None] = lambda done, total: None
) -> Trials:
    """Detect and execute until there are enough grasps, spread over the executor's workers.

    Raises:
        InvalidInputError: in the scenes that were looked at, the method found too few grasps.
        ModelError: there is no such model or device.
    """
    GraspDetector(settings.model, device_of(settings.model, settings.device), settings.seed)
    needed = -(-settings.grasps // settings.per_scene)
    rows: list[tuple[float, float, str]] = []
    start = 0
    progress(0, settings.grasps)
    while len(rows) < settings.grasps and start < _ROUNDS * needed:
        indices = tuple(range(start, start + max(1, -(-(settings.grasps - len(rows)) // settings.per_scene))))
        found: dict[int, list[tuple[float, float, str]]] = {}
        for index, result in executor.run(try_scene, settings, indices):
            found[index] = result
            progress(min(settings.grasps, len(rows) + sum(map(len, found.values()))), settings.grasps)
        rows += [row for index in indices for row in found[index]]
        start += len(indices)
    if len(rows) < settings.grasps:
        raise InvalidInputError(
            f"'{settings.model}' found only {len(rows)} of {settings.grasps} grasps in {start} scenes: ask for fewer, "
            "or take another model or gripper"
        )
    predicted, true, outcomes = zip(*rows[: settings.grasps], strict=True)
    return Trials(np.array(predicted), np.array(true), tuple(outcomes))


def try_scene(settings: TrialSettings, index: int) -> list[tuple[float, float, str]]:
    """Predicted quality, true antipodal score and outcome of the grasps tried in one scene."""
    scene, cloud = settings.scenes(index)
    detection = _detector(settings).detect(cloud.points, settings.gripper, viewpoint=cloud.viewpoint)
    rng = np.random.default_rng([settings.seed, index])
    chosen = detection.grasps[spread_over_quality(detection.grasps.quality, settings.per_scene, rng)]
    if len(chosen) == 0:
        return []
    truth = GroundTruth(scene.world_meshes(), scene.table, fixtures=scene.fixtures)
    aims, simulator = Execution(scene, truth), GraspSimulator(scene, settings.gripper)
    true = truth.antipodal(chosen, settings.gripper).score
    return [
        (float(grasp.quality[0]), float(true[i]), _attempt(simulator, grasp, aims.target(grasp, settings.gripper)))
        for i, grasp in enumerate(chosen)
    ]


def spread_over_quality(quality: Array, count: int, rng: np.random.Generator) -> list[int]:
    """Indices of at most ``count`` grasps whose qualities (M,) are spread evenly between the least and the greatest."""
    left = list(range(len(quality)))
    if len(left) <= count:
        return left
    chosen = []
    for wanted in rng.uniform(quality.min(), quality.max(), count):
        nearest = min(left, key=lambda i: abs(quality[i] - wanted))
        chosen.append(nearest)
        left.remove(nearest)
    return chosen


def describe(settings: TrialSettings, quality: str) -> dict[str, Any]:
    """The settings as plain values, for a policy file."""
    return {
        "grasps": settings.grasps,
        "model": settings.model,
        "quality": quality,
        "gripper_width": settings.gripper.width,
        "seed": settings.seed,
        "scenes": settings.scenes.describe(),
    }


def _attempt(simulator: GraspSimulator, grasp: Grasps, target: int | None) -> str:
    return simulator.attempt(grasp, target).outcome.value


@lru_cache(maxsize=1)
def _library() -> tuple[ObjectModel, ...]:
    return tuple(build_object(spec) for spec in library_specs("test", _LIBRARY))


_detectors: dict[tuple[str, str, int], GraspDetector] = {}
"""Of this process, ready to run."""


def _detector(settings: TrialSettings) -> GraspDetector:
    key = (settings.model, settings.device, settings.seed)
    if key not in _detectors:
        device = device_of(settings.model, settings.device)
        _detectors[key] = GraspDetector(settings.model, device, settings.seed, DetectorConfig(max_grasps=1000))
        limit_torch()
    return _detectors[key]
