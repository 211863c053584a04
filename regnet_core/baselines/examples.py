"""What classifiers of grasps learn from: candidates in views of a data set, judged on the true meshes.

Every view is seen and prepared as a detector gets it (evaluation/observed.py, scene.py), candidates are sampled as in
detection (gpg.py), and each is judged exactly (data/labels/judge.py). Stored is what is in their closing areas, from
which each method makes its own input, and their true score s_q, 0 where the hand hits something.

As in the published code of GPD, of each view there are as many good hands as others, where there are enough of both.
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from regnet_core.baselines.classification import areas_in
from regnet_core.baselines.closing_area import ClosingAreas
from regnet_core.baselines.gpg import Candidates, GpgConfig, GpgSampler
from regnet_core.checks import check_range
from regnet_core.data.generation.executors import Executor
from regnet_core.data.labels.judge import SceneJudges
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.data.storage.tars import write_whole
from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.observed import RecordedViews
from regnet_core.geometry import Array
from regnet_core.gripper import Gripper
from regnet_core.pointcloud import Index
from regnet_core.report import StepRecorder
from regnet_core.scene import Scene, SceneConfig, prepare_scene

_SETTINGS = "settings.json"
_SCENES_OF_A_FILE = 20
Progress = Callable[[int, int], None]
"""Called with the number of files that are done and of all."""


@dataclass(frozen=True)
class ExampleSettings:
    """How examples are made.

    Raises:
        InvalidInputError: a number is out of range.
    """

    scenes: int = 0
    """The first so many of the data set's; 0: all."""
    views: int = 2
    """Views of each scene, drawn at random; all of them where there are fewer."""
    hands: int = 12
    """Most hands of each view and each width of the labels, half of them good ones where there are so many."""
    good_score: float = 0.6
    """What counts as good for that half."""
    most_points: int = 1024
    """Of each closing area."""
    seed: int = 0
    sampler: GpgConfig = field(default_factory=GpgConfig)
    clouds: RecordedViews = field(default_factory=RecordedViews)

    def __post_init__(self) -> None:
        check_range("scenes", self.scenes, 0)
        for name in ("views", "hands", "most_points"):
            check_range(name, getattr(self, name), 1)
        check_range("good_score", self.good_score, 0.0, 1.0)
        check_range("seed", self.seed, 0)

    def to_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class Examples:
    """G judged hands."""

    areas: ClosingAreas
    """With points and normals in half precision."""
    score: npt.NDArray[np.float32]
    """(G,): true s_q; 0 where the hand is not free."""
    width: npt.NDArray[np.float32]
    """(G,): of the gripper [m]."""

    def __len__(self) -> int:
        return len(self.score)

    @classmethod
    def joined(cls, parts: Sequence[Examples]) -> Examples:
        """All of several batches, in their order."""
        empty = np.zeros(0, np.float32)
        return cls(
            ClosingAreas.joined([part.areas for part in parts]),
            np.concatenate([empty, *(part.score for part in parts)]),
            np.concatenate([empty, *(part.width for part in parts)]),
        )

    def to_bytes(self) -> bytes:
        """As a file of numpy's."""
        buffer = io.BytesIO()
        np.savez(
            buffer,
            points=self.areas.points.astype(np.float16),
            normals=self.areas.normals.astype(np.float16),
            offsets=self.areas.offsets,
            score=self.score,
            width=self.width,
        )
        return buffer.getvalue()

    @classmethod
    def load(cls, path: Path) -> Examples:
        """Read what ``to_bytes`` gave.

        Raises:
            InvalidInputError: the file holds something else.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                areas = ClosingAreas(data["points"], data["normals"], data["offsets"])
                return cls(areas, data["score"], data["width"])
        except Exception as error:  # numpy and zipfile raise whatever a damaged file makes them stumble over
            raise InvalidInputError(f"'{path}' holds no examples of grasps: {error}") from error


class ExampleMaker:
    """Makes the examples of a data set's scenes; it goes to other processes."""

    def __init__(self, archive: SceneArchive, settings: ExampleSettings) -> None:
        self.archive, self.settings = archive, settings
        self._judges = SceneJudges(archive)
        self._sampler = GpgSampler(settings.sampler)

    def of_scene(self, scene: int) -> Examples:
        """The examples of a scene; they depend on its number and the settings alone."""
        cfg = self.settings
        rng = np.random.default_rng([cfg.seed, scene])
        there = len(self.archive.info(scene).views)
        chosen = rng.permutation(there)[: cfg.views]
        return Examples.joined([self._of_view(scene, int(view), rng) for view in chosen])

    def _of_view(self, scene: int, view: int, rng: np.random.Generator) -> Examples:
        cloud = self.settings.clouds(self.archive, scene, view)
        prepared = prepare_scene(cloud.points, None, SceneConfig(), rng, StepRecorder(), cloud.viewpoint)
        widths = self.archive.widths
        return Examples.joined([self._of_width(scene, prepared, Gripper(width=width), rng) for width in widths])

    def _of_width(self, scene: int, prepared: Scene, gripper: Gripper, rng: np.random.Generator) -> Examples:
        everywhere = np.ones(len(prepared.objects.points), np.bool_)
        found = self._sampler.sample(prepared, gripper, everywhere, rng)
        score = self._judges[scene].judge(found.rotation, found.translation, gripper).score
        rows = balanced(score >= self.settings.good_score, self.settings.hands, rng)
        areas = self._areas(prepared, found, rows, gripper, rng)
        width = np.full(len(rows), gripper.width, np.float32)
        return Examples(areas, score[rows].astype(np.float32), width)

    def _areas(
        self, prepared: Scene, found: Candidates, rows: Index, gripper: Gripper, rng: np.random.Generator
    ) -> ClosingAreas:
        rotation: Array = found.rotation[rows]
        areas = areas_in(prepared, rotation, found.translation[rows], gripper, self.settings.most_points, rng)
        return ClosingAreas(areas.points.astype(np.float16), areas.normals.astype(np.float16), areas.offsets)


def balanced(good: npt.NDArray[np.bool_], most: int, rng: np.random.Generator) -> Index:
    """At most so many rows (K,), ascending, drawn at random: good ones and others in equal numbers where possible."""
    yes, no = (rng.permutation(np.flatnonzero(mask)) for mask in (good, ~good))
    half = most // 2
    of_good = min(len(yes), max(half, most - len(no)))
    of_others = min(len(no), most - of_good)
    return np.sort(np.concatenate([yes[:of_good], no[:of_others]]))


def make_examples(
    folder: Path,
    archive: SceneArchive,
    settings: ExampleSettings,
    executor: Executor | None = None,
    progress: Progress = lambda done, total: None,
) -> Examples:
    """All examples of a data set, made where they are not there yet, and kept in files of a folder.

    Args:
        folder: of the files; a killed run goes on where it was.
        archive: the data set.
        settings: how they are made.
        executor: where they are made; in this process when None.
        progress: called as files get done.

    Raises:
        InvalidInputError: the folder holds other examples, or a file is damaged.
    """
    _claim(folder, archive, settings)
    scenes = archive.indices[: settings.scenes] if settings.scenes else archive.indices
    files = {
        folder / f"{part[0]:06d}.npz": part
        for part in (scenes[i : i + _SCENES_OF_A_FILE] for i in range(0, len(scenes), _SCENES_OF_A_FILE))
    }
    wanted = {path: part for path, part in files.items() if not path.is_file()}
    done = len(files) - len(wanted)
    progress(done, len(files))
    maker, by_part = ExampleMaker(archive, settings), {part: path for path, part in wanted.items()}
    parts = list(by_part)
    made = ((part, _make(maker, part)) for part in parts) if executor is None else executor.run(_make, maker, parts)
    for part, examples in made:
        write_whole(by_part[part], examples.to_bytes())
        done += 1
        progress(done, len(files))
    return Examples.joined([Examples.load(path) for path in files])


def _make(maker: ExampleMaker, scenes: tuple[int, ...]) -> Examples:
    return Examples.joined([maker.of_scene(scene) for scene in scenes])


def _claim(folder: Path, archive: SceneArchive, settings: ExampleSettings) -> None:
    """Note in the folder what it holds, or check that it holds just that."""
    identity = {"data": archive.manifest.settings.to_dict(), "scenes": len(archive), "examples": settings.to_dict()}
    text = json.dumps(identity, sort_keys=True)
    note = folder / _SETTINGS
    if not note.exists():
        write_whole(note, text.encode())
    elif note.read_text(encoding="utf-8") != text:
        raise InvalidInputError(f"'{folder}' holds examples of other data or settings; give another folder")
