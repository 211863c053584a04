"""Whether methods keep to the gripper that they are told of: proposals on objects that are wider than it opens.

A proposal needs more than W when the object that fills most of its closing region extends over more than W along the
closing direction: the fingers would stand in it. A cup may be held by its wall, so it is the proposal that is
measured, not the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from regnet_core.data.generation.executors import Executor
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.detector import DetectorConfig, GraspDetector
from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.evaluation.observed import CloudSource, ObservedCloud, RecordedViews
from regnet_core.evaluation.study import Progress, device_of, limit_torch, model_labels, naming_the_scene
from regnet_core.evaluation.summary import Estimate, estimate
from regnet_core.geometry import Array
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.models import load_model
from regnet_core.report import StepRecorder
from regnet_core.scene import prepare_scene

BEST = 100
"""So many of the grasps of a detection are its best ones, as in the metrics."""


@dataclass(frozen=True)
class TooWideSettings:
    """What is asked of whom.

    Raises:
        InvalidInputError: there is no model or width, or the range of objects is empty.
    """

    models: tuple[str, ...]
    """As ``GraspDetector`` takes them."""
    scenes: tuple[int, ...]
    """Those without such an object give nothing."""
    widths: tuple[float, ...] = (0.06, 0.12)
    """Gripper widths W that the methods are told [m]."""
    across: tuple[float, float] = (0.07, 0.09)
    """Least and largest size (``size_across``) of the objects that are looked at [m]."""
    clouds: CloudSource = field(default_factory=RecordedViews)
    seed: int = 0
    device: str = "auto"

    def __post_init__(self) -> None:
        if not self.models or not self.widths or not self.scenes:
            raise InvalidInputError("a study of widths needs at least one model, one width and one scene")
        if not 0.0 < self.across[0] < self.across[1]:
            raise InvalidInputError(f"across is (least, largest), above 0 m, got {self.across}")


class Asked(NamedTuple):
    """What a method gave for one scene and one width, of what is on the objects that are looked at."""

    model: str
    """One of ``model_labels``."""
    scene: int
    width: float
    """W, as it was told [m]."""
    proposed: Array
    """(P,) what each of its own proposals needs [m], before the detector checks any."""
    final: Array
    """(F,) the same of the grasps that the detector returns."""
    best: Array
    """The same of the best of these, as many as the metrics look at."""


@dataclass(frozen=True)
class Share:
    """Of the proposals of a method, or of its final grasps."""

    count: int
    above_told: Estimate
    """Share that needs more than the W that was told."""
    above_least: Estimate
    """Share that needs more than the least W that was told."""


@dataclass(frozen=True)
class Row:
    """A method, told one width."""

    model: str
    width: float
    proposed: Share
    final: Share
    best: Share


def size_across(mesh: trimesh.Trimesh) -> float:
    """The least horizontal extent of an object as it lies [m].

    It is the least distance of two upright parallel planes that hold the object between them: a hand that closes
    horizontally round all of it must open further than this.
    """
    outline = np.asarray(mesh.vertices)[:, :2]
    outline = outline[ConvexHull(outline).vertices]
    edge = np.roll(outline, -1, axis=0) - outline
    normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    # A convex outline is narrowest across one of its edges.
    return float(np.ptp(outline @ normal.T, axis=0).min())


def run_too_wide(
    archive: SceneArchive,
    settings: TooWideSettings,
    executor: Executor,
    progress: Progress = lambda done, total: None,
) -> list[Asked]:
    """Ask all methods in all scenes; ordered by scene, width and method.

    Raises:
        InvalidInputError: there is no such model or device.
        EvaluationError: a scene could not be judged.
    """
    for model in settings.models:
        load_model(model, device_of(model, settings.device))
    found: dict[int, list[Asked]] = {}
    for scene, asked in executor.run(ask_in_scene, (archive, settings), settings.scenes):
        found[scene] = asked
        progress(len(found), len(settings.scenes))
    return [asked for scene in settings.scenes for asked in found[scene]]


def ask_in_scene(shared: tuple[SceneArchive, TooWideSettings], index: int) -> list[Asked]:
    """All methods in one scene; nothing where it has no object of the size.

    Raises:
        EvaluationError: it could not be judged; the message names it.
    """
    archive, settings = shared
    with naming_the_scene(archive, index):
        return _ask_in_scene(archive, settings, index)


def needed_on(truth: GroundTruth, grasps: Grasps, gripper: Gripper, objects: Sequence[int] | np.ndarray) -> Array:
    """(K,) what those of the grasps that are on some objects, given by index, need to be open [m]."""
    enclosed = truth.enclosed(grasps, gripper)
    return enclosed.width[np.isin(enclosed.object_index, objects)]


def summarise_too_wide(results: Sequence[Asked]) -> list[Row]:
    """For each width and each method, by rising width."""
    if not results:
        return []
    least = min(asked.width for asked in results)
    groups: dict[tuple[float, str], list[Asked]] = {}
    for asked in results:
        groups.setdefault((asked.width, asked.model), []).append(asked)
    rows = []
    for width, model in sorted(groups, key=lambda group: group[0]):
        own = groups[width, model]
        scenes = [asked.scene for asked in own]
        stages = [[getattr(asked, stage) for asked in own] for stage in ("proposed", "final", "best")]
        rows.append(Row(model, width, *(_share(needed, scenes, width, least) for needed in stages)))
    return rows


def _ask_in_scene(archive: SceneArchive, settings: TooWideSettings, index: int) -> list[Asked]:
    scene = archive.scene(index)
    meshes = scene.world_meshes()
    sizes = np.array([size_across(mesh) for mesh in meshes])
    objects = np.flatnonzero((sizes >= settings.across[0]) & (sizes <= settings.across[1]))
    if len(objects) == 0:
        return []
    cloud = settings.clouds(archive, index, index % len(archive.info(index).views))
    truth, names = GroundTruth(meshes, scene.table, fixtures=scene.fixtures), model_labels(settings.models)
    results = []
    for gripper in (Gripper(width=width) for width in settings.widths):
        for model in settings.models:
            proposed, final = _ask(settings, model, cloud, gripper)
            needed = [needed_on(truth, grasps, gripper, objects) for grasps in (proposed, final, final[:BEST])]
            results.append(Asked(names[model], index, gripper.width, *needed))
    return results


def _share(needed: Sequence[Array], scenes: Sequence[int], width: float, least: float) -> Share:
    every, owner = np.concatenate(needed), np.repeat(scenes, [len(one) for one in needed])
    return Share(len(every), estimate(every > width, owner), estimate(every > least, owner))


def _ask(settings: TooWideSettings, model: str, cloud: ObservedCloud, gripper: Gripper) -> tuple[Grasps, Grasps]:
    """What the method proposes for the very scene that the detector shows it, and what the detector returns."""
    config = DetectorConfig()
    rng = np.random.default_rng(settings.seed)
    scene = prepare_scene(cloud.points, None, config.scene, rng, StepRecorder(), cloud.viewpoint)
    device = device_of(model, settings.device)
    detector = GraspDetector(model, device, settings.seed, config)
    limit_torch()
    proposed = load_model(model, device).proposer.propose(scene, gripper, None, rng).grasps
    return proposed, detector.detect(cloud.points, gripper, viewpoint=cloud.viewpoint).grasps
