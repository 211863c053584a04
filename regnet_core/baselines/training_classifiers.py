"""How classifiers of grasps learn: cross entropy on judged candidates, half of each batch good ones."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from regnet_core.baselines.classification import GraspClassifier
from regnet_core.baselines.closing_area import ClosingAreas
from regnet_core.baselines.examples import Examples
from regnet_core.baselines.training import BaselineRecipe, Loss
from regnet_core.errors import InvalidInputError
from regnet_core.nn.precision import autocast
from regnet_core.pointcloud import Index

_VALIDATED = 256
"""Examples that are looked at in one go in validation."""


class ClassifierLesson:
    """Examples for a classifier."""

    def __init__(
        self,
        network: GraspClassifier,
        recipe: BaselineRecipe,
        examples: Examples,
        source: dict[str, Any],
        validation: Examples | None = None,
        device: str = "cpu",
    ) -> None:
        """Args:
            network: what learns.
            recipe: of the run.
            examples: to learn from.
            source: what they were made of, as JSON has it.
            validation: to be judged on.
            device: where to train.

        Raises:
            InvalidInputError: there are no good hands, or only good ones.
        """
        self.device = torch.device(device)
        self.network = network.to(self.device)
        self._recipe, self._examples, self._source = recipe, examples, source
        self._validation = validation
        told = examples.areas.counts >= network.least_points
        good = examples.score >= network.good_score
        self._good, self._others = np.flatnonzero(told & good), np.flatnonzero(told & ~good)
        if len(self._good) == 0 or len(self._others) == 0:
            raise InvalidInputError(
                f"a classifier learns from good hands and others, and there are {len(self._good)} and "
                f"{len(self._others)}: give more scenes"
            )

    def losses(self, first: int, last: int) -> Iterator[Loss]:
        for step in range(first, last):
            rng = np.random.default_rng([self._recipe.seed, step])
            half = self._recipe.batch // 2
            rows = np.concatenate([rng.choice(self._good, half), rng.choice(self._others, self._recipe.batch - half)])
            areas = self._thinned(self._examples.areas.take(rows), rng)
            # A jaw has two forms; which one a hand comes in means nothing.
            areas = areas.flipped(rng.random(len(areas)) < 0.5)
            label = torch.zeros(len(rows), dtype=torch.int64, device=self.device)
            label[:half] = 1
            with autocast(self.device):
                logits = self.network(areas)
            loss = functional.cross_entropy(logits, label)
            right = (logits.detach().argmax(dim=1) == label).float().mean()
            yield Loss(loss, {"accuracy": right.item()})

    def identity(self) -> dict[str, Any]:
        return {"data": self._source}

    def validate(self) -> dict[str, float]:
        if self._validation is None:
            return {}
        told = np.flatnonzero(self._validation.areas.counts >= self.network.least_points)
        rng = np.random.default_rng(0)
        parts = []
        for start in range(0, len(told), _VALIDATED):
            areas = self._thinned(self._validation.areas.take(told[start : start + _VALIDATED]), rng)
            with autocast(self.device):
                parts.append(self.network(areas))
        logits = torch.cat(parts)
        label = torch.from_numpy(self._validation.score[told] >= self.network.good_score).to(self.device)
        positive, found = label, logits.softmax(dim=1)[:, 1] > 0.6
        return {
            "loss": functional.cross_entropy(logits, label.long()).item(),
            "accuracy": (logits.argmax(dim=1) == label.long()).float().mean().item(),
            "precision at 0.6": ((found & positive).sum() / found.sum().clamp(min=1)).item(),
            "recall at 0.6": ((found & positive).sum() / positive.sum().clamp(min=1)).item(),
        }

    def _thinned(self, areas: ClosingAreas, rng: np.random.Generator) -> ClosingAreas:
        """The areas in single precision, with at most as many points as the network looks at."""
        most = self.network.most_points
        rows = [
            np.arange(first, last) if last - first <= most else first + rng.choice(last - first, most, replace=False)
            for first, last in zip(areas.offsets[:-1], areas.offsets[1:], strict=True)
        ]
        kept: Index = np.concatenate(rows) if rows else np.zeros(0, np.int64)
        offsets = np.concatenate([[0], np.cumsum([len(own) for own in rows])]).astype(np.int64)
        return ClosingAreas(areas.points[kept].astype(np.float32), areas.normals[kept].astype(np.float32), offsets)
