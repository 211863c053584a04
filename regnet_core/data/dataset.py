"""The data set as torch reads it: one sample is one view of a scene for one gripper width."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import Dataset

from regnet_core.checks import check_range
from regnet_core.data.labels.narrowing import confidence_between, fitting, kept_share
from regnet_core.data.labels.scene_labels import GraspLabels
from regnet_core.data.storage.archive import SceneArchive, view_points
from regnet_core.errors import InvalidInputError
from regnet_core.pointcloud import surroundings

POINTS = 25600
"""N of the paper."""
_FIXTURE = -2
NARROWEST = 0.03
"""The narrowest gripper that samples are drawn for [m]."""


@dataclass(frozen=True)
class GraspSample:
    """N points of one view, and all labels of its scene for one width; everything in the world frame, z up [m].

    Attributes:
        points: (N, 3) float32, drawn at random from the view around the objects.
        colors: (N, 3) float32 in [0, 1].
        confidence: (N,) float32 point grasp confidence, eq. (1).
        object_index: (N,) int64; -1 the table, -2 a fixture.
        width: () float32, the gripper's W.
        viewpoint: (3,) float32, the camera's position.
        turn: (3, 3) float32, the rotation about ``PIVOT`` that the sample was turned by; the identity unless augmented.
        translation: (M, 3) float32, grasp centres c.
        rotation: (M, 3, 3) float32, columns X, Y, Z in canonical form.
        score: (M,) float32, s_q.
        contacts: (M, 2) float32, y of the contacts at -Y and +Y in the grasp frame.
        entry_point: (M, 3) float32, where the approach axes enter the objects.
        grasp_object: (M,) int64, the object grasped.
        scene: number of the scene.
        view: number of the view.
    """

    points: torch.Tensor
    colors: torch.Tensor
    confidence: torch.Tensor
    object_index: torch.Tensor
    width: torch.Tensor
    viewpoint: torch.Tensor
    turn: torch.Tensor
    translation: torch.Tensor
    rotation: torch.Tensor
    score: torch.Tensor
    contacts: torch.Tensor
    entry_point: torch.Tensor
    grasp_object: torch.Tensor
    scene: int
    view: int


@dataclass(frozen=True)
class GraspBatch:
    """B samples. What has N rows in a sample is stacked to (B, N, ...); what has M rows is joined to (M_1 + ... + M_B).

    Attributes:
        grasp_batch: (M_1 + ... + M_B,) int64, the sample that a grasp belongs to.
    """

    points: torch.Tensor
    colors: torch.Tensor
    confidence: torch.Tensor
    object_index: torch.Tensor
    width: torch.Tensor
    viewpoint: torch.Tensor
    turn: torch.Tensor
    translation: torch.Tensor
    rotation: torch.Tensor
    score: torch.Tensor
    contacts: torch.Tensor
    entry_point: torch.Tensor
    grasp_object: torch.Tensor
    grasp_batch: torch.Tensor
    scene: tuple[int, ...]
    view: tuple[int, ...]

    def to(self, device: torch.device | str) -> GraspBatch:
        """The same on another device."""
        moved = {
            name: getattr(self, name).to(device, non_blocking=True) for name in (*_STACKED, *_JOINED, "grasp_batch")
        }
        return dataclasses.replace(self, **moved)


PIVOT = (0.0, 0.0, 0.75)
"""The middle of the table's top, about which augmentation turns scenes [m]."""
_STACKED = ("points", "colors", "confidence", "object_index", "width", "viewpoint", "turn")
_JOINED = ("translation", "rotation", "score", "contacts", "entry_point", "grasp_object")


def collate(samples: Sequence[GraspSample]) -> GraspBatch:
    """For ``torch.utils.data.DataLoader(collate_fn=...)``: nothing is padded."""
    stacked = {name: torch.stack([getattr(sample, name) for sample in samples]) for name in _STACKED}
    joined = {name: torch.cat([getattr(sample, name) for sample in samples]) for name in _JOINED}
    counts = torch.tensor([len(sample.score) for sample in samples])
    return GraspBatch(
        **stacked,
        **joined,
        grasp_batch=torch.repeat_interleave(torch.arange(len(samples)), counts),
        scene=tuple(sample.scene for sample in samples),
        view=tuple(sample.view for sample in samples),
    )


class GraspDataset(Dataset[GraspSample]):
    """Samples of a data set made by ``regnet generate``; number i is a scene, a view of it, and a width.

    The points drawn depend on the seed, the epoch and the sample's number, not on the worker that draws them.
    """

    def __init__(
        self,
        folder: Path | str,
        points: int = POINTS,
        *,
        widths: Sequence[float] | None = None,
        scenes: Sequence[int] | None = None,
        seed: int = 0,
        between: float = 0.0,
    ) -> None:
        """Args:
            folder: of the data set.
            points: N; a view with fewer points gives some of them several times.
            widths: those of the data set's widths to use [m]; all of them when None.
            scenes: numbers of the scenes to use; all of them when None.
            seed: of the points that are drawn.
            between: share of the samples that are for a width between those of the labels, or below the least.

        Raises:
            InvalidInputError: no data set, or a width or scene that it does not have.
        """
        check_range("points", points, 1, 10_000_000)
        check_range("between", between, 0.0, 1.0)
        self.archive = SceneArchive(folder)
        self.points = points
        self._widths = [_index_of(width, self.archive.widths) for width in widths or self.archive.widths]
        self._scenes = tuple(self.archive.indices if scenes is None else scenes)
        unknown = sorted(set(self._scenes) - set(self.archive.indices))
        if unknown:
            raise InvalidInputError(f"'{folder}' has {len(self.archive)} scenes, and none numbered {unknown[:5]}")
        if not self._scenes:
            raise InvalidInputError(f"'{folder}' has no finished shard of scenes yet")
        self._views = self.archive.manifest.settings.views
        self._seed = seed
        self._between = between
        self._epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Other points from now on; call it before each epoch, and before the loader starts its workers."""
        self._epoch = epoch

    def __len__(self) -> int:
        return len(self._scenes) * self._views * len(self._widths)

    def __getitem__(self, number: int) -> GraspSample:
        if not 0 <= number < len(self):
            raise IndexError(f"sample {number} of a data set of {len(self)}")
        rest, w = divmod(number, len(self._widths))
        scene, view = divmod(rest, self._views)
        rng = np.random.default_rng([self._seed, self._epoch, number])
        return self._sample(self._scenes[scene], view, self._widths[w], rng)

    def _sample(self, scene: int, view: int, w: int, rng: np.random.Generator) -> GraspSample:
        info = self.archive.info(scene)
        seen = info.views[view]
        data = self.archive.view(scene, view)
        rows, columns = np.nonzero(np.isfinite(data.depth))
        if len(rows) == 0:
            raise InvalidInputError(f"view {view} of scene {scene} has no points")
        points = view_points(seen, data, rows, columns)
        owner = data.object_index[rows, columns].astype(np.int64)
        drawn = _drawn(surroundings(points, points[(owner >= 0) | (owner == _FIXTURE)]), self.points, rng)
        points, rows, columns, owner = points[drawn], rows[drawn], columns[drawn], owner[drawn]
        confidence = data.confidence[:, rows, columns]
        width, labels, confidence = self._for_width(
            w, self.archive.labels(scene)[w], confidence, owner, len(info.objects), rng
        )
        return GraspSample(
            points=torch.from_numpy(points),
            colors=torch.from_numpy(data.colours[rows, columns].astype(np.float32) / np.float32(255.0)),
            confidence=torch.from_numpy(np.ascontiguousarray(confidence, np.float32)),
            object_index=torch.from_numpy(owner),
            width=torch.tensor(width, dtype=torch.float32),
            viewpoint=torch.from_numpy(seen.camera.position.astype(np.float32)),
            turn=torch.eye(3),
            scene=scene,
            view=view,
            **_grasp_tensors(labels),
        )

    def _for_width(
        self,
        w: int,
        labels: GraspLabels,
        confidence: np.ndarray,
        owner: np.ndarray,
        objects: int,
        rng: np.random.Generator,
    ) -> tuple[float, GraspLabels, np.ndarray]:
        """A width, the grasps it can do, and the confidence (N,), given that for all labelled widths (W, N)."""
        width = self.archive.widths[w]
        if rng.random() >= self._between:
            return width, labels, confidence[w]
        share = rng.random()
        if w > 0:
            width -= share * (width - self.archive.widths[w - 1])
            return width, labels[fitting(labels, width)], confidence_between(confidence[w], confidence[w - 1], share)
        width -= share * max(width - NARROWEST, 0.0)
        kept = fitting(labels, width)
        of_object = np.append(kept_share(labels, kept, objects), 1.0)
        return width, labels[kept], confidence[w] * of_object[np.maximum(owner, -1)]


def _drawn(rows: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """So many of the rows, each at most once where there are enough, and at least once where there are not."""
    if len(rows) >= count:
        return rng.choice(rows, count, replace=False)
    return np.concatenate([rows, rng.choice(rows, count - len(rows))])


def _grasp_tensors(labels: GraspLabels) -> dict[str, torch.Tensor]:
    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    return {
        "translation": tensor(labels.translation),
        "rotation": tensor(labels.rotation),
        "score": tensor(labels.score),
        "contacts": tensor(labels.contacts),
        "entry_point": tensor(labels.entry_points),
        "grasp_object": torch.from_numpy(labels.object_index),
    }


def _index_of(width: float, widths: tuple[float, ...]) -> int:
    for i, there in enumerate(widths):
        if abs(there - width) < 1e-9:
            return i
    raise InvalidInputError(f"the data set has labels for the widths {', '.join(map(str, widths))} m, not {width}")
