"""How S4G learns: at every point of a view, the best of the labelled grasps that enter the object there.

The paper searches hands at every point; the data set has hands at many points of each object (docs/dataset.md). The
grasps of a point are those whose approach axis enters the object within ``reach`` of it. The point's score is the best
one's; of grasps that are as good, to a tenth, its pose is that of the one coming most from above, so that points next
to each other learn alike. Points without a grasp have the lowest class, unless grasps are known to be possible there.

The loss is the published one: cross entropy of the score's class, with half the weight for the lowest, the squared
difference of rotations to the nearer of the jaw's two forms, and that of the offsets, both weighted by the score.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch.nn import functional
from torch.utils.data import DataLoader

from regnet_core.baselines.s4g import WIDTH, S4gNetwork, S4gOutput
from regnet_core.baselines.s4g_coding import decode_rotation, encode_offset, score_class, symmetric_error
from regnet_core.baselines.training import BaselineRecipe, Loss
from regnet_core.checks import check_range
from regnet_core.data.dataset import GraspBatch, GraspDataset, collate
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.precision import autocast
from regnet_core.training.augmentation import AugmentedDataset
from regnet_core.training.recipe import Augmentation

IGNORED = -1
"""Class of points that do not count."""
_NEAREST = 12
"""Grasps that are looked at for each point, the nearest ones."""


@dataclass(frozen=True)
class S4gLoss:
    """Labels and weights.

    Raises:
        InvalidInputError: a number is out of range.
    """

    reach: float = 0.008
    """Grasps belong to points so near to where they enter the object [m]."""
    uncertain: float = 0.05
    """Points without a grasp but with more confidence than this are ignored."""
    lowest_class: float = 0.5
    """Weight of the lowest class; the others have 1."""
    rotation: float = 5.0
    """Weight of the rotation's term."""
    offset: float = 1.0
    """Weight of the offset's term, in the network's units. The published 20 is for metres, and hardly counts."""

    def __post_init__(self) -> None:
        check_range("reach", self.reach, 1e-4, 0.1, "m")
        for name in ("uncertain", "lowest_class", "rotation", "offset"):
            check_range(name, getattr(self, name), 0.0)


class PointTargets(NamedTuple):
    """What N points should predict."""

    score: torch.Tensor
    """(N,): of the best grasp, 0 without one."""
    label: torch.Tensor
    """(N,) int64: its class, or IGNORED."""
    rotation: torch.Tensor
    """(N, 3, 3): of that grasp; the identity without one."""
    offset: torch.Tensor
    """(N, 3): in the network's units."""


class Grasped(NamedTuple):
    """M labelled grasps of one view, all on the CPU."""

    translation: torch.Tensor
    rotation: torch.Tensor
    score: torch.Tensor
    entry: torch.Tensor
    """(M, 3): where they enter the object [m]."""

    @classmethod
    def of(cls, batch: GraspBatch, sample: int) -> Grasped:
        """Those of a sample of a batch."""
        rows = batch.grasp_batch == sample
        values = (batch.translation, batch.rotation, batch.score, batch.entry_point)
        return cls(*(value[rows].cpu() for value in values))


def point_targets(
    points: torch.Tensor, confidence: torch.Tensor, grasps: Grasped, classes: int, unit: float, loss: S4gLoss
) -> PointTargets:
    """The targets of one view's points (N, 3) with confidence (N,), given its grasps."""
    n = len(points)
    score, chosen = torch.zeros(n), torch.full((n,), -1, dtype=torch.int64)
    if len(grasps.score):
        best = _best_near(points.numpy(), grasps, loss.reach)
        chosen = torch.from_numpy(best)
        score = torch.where(chosen >= 0, grasps.score[chosen.clamp(min=0)], score)
    has = chosen >= 0
    label = torch.where(has, score_class(score, classes), 0)
    label = torch.where(~has & (confidence > loss.uncertain), IGNORED, label)
    rotation = torch.eye(3).repeat(n, 1, 1)
    offset = torch.zeros(n, 3)
    rotation[has] = grasps.rotation[chosen[has]]
    offset[has] = encode_offset(points[has], grasps.translation[chosen[has]], unit)
    return PointTargets(score, label, rotation, offset)


def point_loss(output: S4gOutput, target: PointTargets, loss: S4gLoss) -> Loss:
    """The loss of predictions at N points; a term without anything to count is 0."""
    classes = output.score.shape[1]
    weight = torch.ones(classes, device=output.score.device)
    weight[0] = loss.lowest_class
    counts = target.label != IGNORED
    # Not the mean that torch takes: over nothing it is NaN.
    score = functional.cross_entropy(output.score[counts], target.label[counts], weight, reduction="sum")
    score = score / weight[target.label[counts]].sum().clamp(min=1.0)
    graspable = target.label > 0
    share = target.score[graspable]
    rotation = symmetric_error(decode_rotation(output.rotation[graspable]), target.rotation[graspable])
    offset = (output.offset[graspable] - target.offset[graspable]).square().mean(dim=1)
    number = max(int(graspable.sum()), 1)
    rotation, offset = (rotation * share).sum() / number, (offset * share).sum() / number
    total = score + loss.rotation * rotation + loss.offset * offset
    return Loss(total, {"score": score.item(), "rotation": rotation.item(), "offset": offset.item()})


class S4gLesson:
    """Views of a data set for S4G."""

    def __init__(
        self,
        network: S4gNetwork,
        recipe: BaselineRecipe,
        data: GraspDataset,
        validation: GraspDataset | None = None,
        device: str = "cpu",
        workers: int = 0,
        loss: S4gLoss | None = None,
    ) -> None:
        """Args:
        network: what learns.
        recipe: of the run.
        data: samples for the one width.
        validation: samples to be judged on.
        device: where to train.
        workers: processes that read data.
        loss: labels and weights.
        """
        self.device = torch.device(device)
        self.network = network.to(self.device)
        self._recipe, self._data, self._validation = recipe, data, validation
        self._workers, self._loss = workers, loss or S4gLoss()

    def losses(self, first: int, last: int) -> Iterator[Loss]:
        step, batch = first, self._recipe.batch
        per_epoch = max(len(self._data) // batch, 1)
        while step < last:
            epoch, done = divmod(step, per_epoch)
            dataset = AugmentedDataset(self._data, Augmentation(), self._recipe.seed)
            dataset.set_epoch(epoch)
            order = np.random.default_rng([self._recipe.seed, epoch]).permutation(len(dataset))
            rows = np.resize(order, per_epoch * batch).reshape(per_epoch, batch)[done : done + last - step]
            for found in self._loader(dataset, rows):
                yield self._loss_of(found)
                step += 1

    def identity(self) -> dict[str, Any]:
        archive = self._data.archive
        data = {"settings": archive.manifest.settings.to_dict(), "scenes": len(archive), "points": self._data.points}
        return {"data": data, "width": WIDTH}

    def validate(self) -> dict[str, float]:
        if self._validation is None:
            return {}
        rows = np.linspace(0, len(self._validation) - 1, min(16, len(self._validation))).round().astype(int)
        found = [self._loss_of(collate([self._validation[int(row)]])) for row in rows]
        return {name: float(np.mean([loss.terms[name] for loss in found])) for name in found[0].terms}

    def _loss_of(self, batch: GraspBatch) -> Loss:
        cfg = self.network.config
        parts = [
            point_targets(points, confidence, Grasped.of(batch, sample), cfg.classes, cfg.unit, self._loss)
            for sample, (points, confidence) in enumerate(zip(batch.points, batch.confidence, strict=True))
        ]
        target = PointTargets(*(torch.cat(values).to(self.device) for values in zip(*parts, strict=True)))
        clouds = Clouds.stacked(batch.points, batch.width).to(self.device)
        with autocast(self.device):
            output = self.network(clouds)
        return point_loss(output, target, self._loss)

    def _loader(self, dataset: AugmentedDataset, rows: np.ndarray) -> DataLoader[GraspBatch]:
        return DataLoader(
            dataset,  # type: ignore[arg-type]
            batch_sampler=rows.tolist(),
            num_workers=self._workers,
            collate_fn=collate,
            # Spawned: the threads of torch and numba do not survive a fork.
            multiprocessing_context="spawn" if self._workers else None,
        )


def _best_near(points: np.ndarray, grasps: Grasped, reach: float) -> np.ndarray:
    """(N,): the row of the best grasp that enters within the reach of each point (N, 3); -1 where there is none."""
    count = min(_NEAREST, len(grasps.score))
    distance, rows = cKDTree(grasps.entry.numpy()).query(points, k=np.arange(1, count + 1), distance_upper_bound=reach)
    near = np.isfinite(distance)
    rows = np.where(near, rows, 0)
    score = grasps.score.numpy().astype(np.float64)
    from_above = -grasps.rotation[:, 2, 0].numpy()
    rank = np.where(near, np.floor(10.0 * score + 1e-6)[rows] + 0.4 * from_above[rows], -np.inf)
    best = rank.argmax(axis=1)[:, None]
    return np.where(near.any(axis=1), np.take_along_axis(rows, best, axis=1)[:, 0], -1)
