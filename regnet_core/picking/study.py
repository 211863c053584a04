"""Bin picking by any models, policies and cameras, several episodes each, on all cores; interrupted, it goes on.

An episode's result depends on the settings, its cell and its number alone. Each is a file, written when it is done:

    DIR/episodes/SCENE.MODEL.POLICY.CAMERA/NNN.json
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from regnet_core.checks import check_range, is_whole
from regnet_core.collision import CollisionConfig
from regnet_core.data.cameras.sensors import SENSORS
from regnet_core.data.generation.executors import Executor
from regnet_core.data.storage.manifest import checksum, library_versions
from regnet_core.data.storage.tars import remove_leftovers
from regnet_core.detector import DetectorConfig, GraspDetector
from regnet_core.errors import InvalidInputError, RegnetError
from regnet_core.evaluation.study import device_of, limit_torch, model_labels
from regnet_core.gripper import Gripper
from regnet_core.models import is_weights_path
from regnet_core.picking.episode import Episode
from regnet_core.picking.observation import DepthCamera
from regnet_core.picking.planner import GraspPlanner, PlanConfig
from regnet_core.picking.records import Record, episode_record, read_record, write_record
from regnet_core.picking.robot import PickRobot
from regnet_core.picking.scenes import make_scene, pick_scene
from regnet_core.picking.workcell import CAMERA_POSES, camera_at
from regnet_core.policy import POLICIES, make_policy
from regnet_core.sim.config import SimConfig
from regnet_core.sim.transfer import TransferConfig
from regnet_core.weights import network_names, weights_file

Progress = Callable[[int, int], None]
"""Called with the number of episodes that are done and of all."""
_MOST_EPISODES = 1000
PROTOCOL = "2"
"""To be counted up with every change that gives other results under the same settings."""
_DOMAIN = 0xB1
"""Sets the camera's noise apart from other random numbers."""


class PickingError(RegnetError):
    """An episode could not be run; the message names it."""


class Cell(NamedTuple):
    """One combination that is studied."""

    scene: str
    model: str
    """As ``GraspDetector`` takes it."""
    policy: str
    camera: str


@dataclass(frozen=True)
class PickSettings:
    """What is compared, and how.

    Raises:
        InvalidInputError: something does not exist, is given twice, or is out of range.
    """

    scenes: tuple[str, ...]
    """As ``pick_scene`` takes them."""
    models: tuple[str, ...]
    """As ``GraspDetector`` takes them."""
    policies: tuple[str, ...]
    """Of POLICIES."""
    cameras: tuple[str, ...]
    """Of CAMERA_POSES."""
    episodes: int = 5
    """Of each cell; all cells have the same scenes."""
    width: float = 0.08
    """W of the gripper [m]."""
    sensor: str = "kinect_v2"
    """Of SENSORS."""
    seed: int = 0
    """Of objects, scenes, the camera's noise and the detectors."""
    device: str = "auto"
    """Where networks run."""
    plan: PlanConfig = field(default_factory=PlanConfig)
    physics: SimConfig = field(default_factory=SimConfig)
    transfer: TransferConfig = field(default_factory=TransferConfig)

    def __post_init__(self) -> None:
        for name in ("scenes", "models", "policies", "cameras"):
            values = getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise InvalidInputError(f"{name} must be different from each other, at least one, got {values}")
        for scene in self.scenes:
            pick_scene(scene)
        for name, there in (("policies", tuple(POLICIES)), ("cameras", tuple(CAMERA_POSES))):
            unknown = [value for value in getattr(self, name) if value not in there]
            if unknown:
                raise InvalidInputError(f"{name} are {', '.join(there)}; got '{unknown[0]}'")
        if self.sensor not in SENSORS:
            raise InvalidInputError(f"sensors are {', '.join(SENSORS)}; got '{self.sensor}'")
        for name, low, high in (("episodes", 1, _MOST_EPISODES), ("seed", 0, 2**31 - 1)):
            if not is_whole(getattr(self, name)):
                raise InvalidInputError(f"{name} must be a whole number, got {getattr(self, name)!r}")
            check_range(name, getattr(self, name), low, high)
        Gripper(width=self.width)

    @property
    def cells(self) -> tuple[Cell, ...]:
        """All combinations."""
        return tuple(
            Cell(scene, model, policy, camera)
            for scene in self.scenes
            for model in self.models
            for policy in self.policies
            for camera in self.cameras
        )

    @property
    def jobs(self) -> tuple[Job, ...]:
        """All episodes; those in one scene come one after another, as making it takes a while."""
        return tuple(
            Job(cell, episode)
            for scene in self.scenes
            for episode in range(self.episodes)
            for cell in self.cells
            if cell.scene == scene
        )

    def names(self, cell: Cell) -> dict[str, str]:
        """The cell with a short name for its model."""
        return {**cell._asdict(), "model": model_labels(self.models)[cell.model]}

    def conditions(self, cell: Cell) -> dict[str, Any]:
        """All that an episode of the cell depends on besides its cell and its number, as JSON has it."""
        return {
            "width": self.width,
            "sensor": self.sensor,
            "seed": self.seed,
            "device": device_of(cell.model, self.device),
            "weights": _weights_digest(cell.model),
            "plan": dataclasses.asdict(self.plan),
            "physics": dataclasses.asdict(self.physics),
            "transfer": dataclasses.asdict(self.transfer),
            "versions": {"protocol": PROTOCOL, **library_versions(), "torch": version("torch")},
        }


class Job(NamedTuple):
    """One episode of one cell."""

    cell: Cell
    episode: int


class EpisodeStore:
    """The finished episodes of a folder."""

    def __init__(self, folder: Path, settings: PickSettings) -> None:
        """Args: where they are, and what is studied."""
        self._folder = folder
        self._settings = settings

    def path(self, job: Job) -> Path:
        """The file of an episode."""
        names = self._settings.names(job.cell)
        cell = ".".join(name.replace("/", "_") for name in names.values())
        return self._folder / "episodes" / cell / f"{job.episode:03d}.json"

    def missing(self) -> list[Job]:
        """The episodes that are not there yet.

        Raises:
            InvalidInputError: an episode is damaged, or is there under other conditions.
        """
        remove_leftovers(*{self.path(job).parent for job in self._settings.jobs})
        return [job for job in self._settings.jobs if not self.path(job).is_file() or not self.read(job)]

    def read(self, job: Job) -> dict[str, Any]:
        """A finished episode.

        Raises:
            InvalidInputError: it is not there, damaged, or was run under other conditions.
        """
        path = self.path(job)
        record = read_record(path)
        wanted = self._settings.conditions(job.cell)
        changed = [
            f"{name}: {record['conditions'].get(name)!r} there, {value!r} asked for"
            for name, value in wanted.items()
            if record["conditions"].get(name) != value
        ]
        if changed:
            raise InvalidInputError(
                f"'{path}' was run under other conditions ({'; '.join(changed)}); give the same ones or another folder"
            )
        return record

    def write(self, job: Job, record: Record) -> None:
        """Store an episode."""
        write_record(self.path(job), record)


def run_study(
    folder: Path, settings: PickSettings, executor: Executor, progress: Progress = lambda done, total: None
) -> list[dict[str, Any]]:
    """Run the episodes that are missing in the folder; the records of all, in the order of ``settings.jobs``.

    Raises:
        InvalidInputError: there is no such model or device, or the folder holds episodes of other conditions.
        PickingError: an episode could not be run.
    """
    for model in settings.models:
        make_detector(settings, model)
    store, jobs = EpisodeStore(folder, settings), settings.jobs
    missing = store.missing()
    done = len(jobs) - len(missing)
    progress(done, len(jobs))
    for job, record in executor.run(run_episode, settings, missing):
        store.write(job, record)
        done += 1
        progress(done, len(jobs))
    return [store.read(job) for job in jobs]


def run_episode(settings: PickSettings, job: Job) -> dict[str, Any]:
    """The record of one episode.

    Raises:
        PickingError: it could not be run; the message names it.
    """
    with _naming(settings, job):
        cell, episode = job
        wanted, scene = pick_scene(cell.scene), make_scene(cell.scene, settings.seed, episode)
        workcell = wanted.workcell
        gripper, sensor = Gripper(width=settings.width), SENSORS[settings.sensor]
        detector = make_detector(settings, cell.model)
        limit_torch()
        way = settings.physics.pre_grasp_distance
        planner = GraspPlanner(detector, make_policy(cell.policy), gripper, workcell, settings.plan, way)
        camera = DepthCamera(camera_at(cell.camera, sensor.intrinsics), sensor, workcell.seen)
        robot = pick_robot(settings, job)
        result = Episode(robot, workcell, camera, planner, settings.plan.looks, wanted.rule).run(
            np.random.default_rng([_DOMAIN, settings.seed, episode])
        )
        objects = tuple(model.name for model in scene.objects)
        return episode_record(result, settings.names(cell), episode, objects, settings.conditions(cell))


def make_detector(settings: PickSettings, model: str) -> GraspDetector:
    """The method with the integrator's settings.

    Raises:
        ModelError: there is no such model or device, or its weights cannot be used.
    """
    config = DetectorConfig(collision=CollisionConfig(margin=settings.plan.margin))
    return GraspDetector(model, device_of(model, settings.device), settings.seed, config)


def pick_robot(settings: PickSettings, job: Job) -> PickRobot:
    """The hand in the scene of an episode."""
    scene = make_scene(job.cell.scene, settings.seed, job.episode)
    workcell = pick_scene(job.cell.scene).workcell
    return PickRobot(scene, workcell, Gripper(width=settings.width), settings.physics, settings.transfer)


@contextmanager
def _naming(settings: PickSettings, job: Job) -> Iterator[None]:
    """Any error inside becomes a PickingError that says which episode it was."""
    try:
        yield
    except Exception as error:
        what = str(error) if isinstance(error, RegnetError) else f"{type(error).__name__}: {error}"
        names = ", ".join(settings.names(job.cell).values())
        raise PickingError(f"episode {job.episode} of {names} cannot be run: {what}") from error


def _weights_digest(model: str) -> str | None:
    """sha256 of a network's weights; None for a baseline."""
    if is_weights_path(model):
        return checksum(Path(model).expanduser())
    return checksum(weights_file(model).path) if model in network_names() else None


def only_cell(settings: PickSettings) -> Cell:
    """The one combination.

    Raises:
        InvalidInputError: there are several.
    """
    cells: Sequence[Cell] = settings.cells
    if len(cells) > 1:
        raise InvalidInputError(f"this needs one scene, model, policy and camera, got {len(cells)} combinations")
    return cells[0]
