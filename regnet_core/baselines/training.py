"""The training loop of the baselines: resumable, and reproducible from its recipe."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from torch import nn

from regnet_core.baselines.files import save_weights
from regnet_core.checks import check_range
from regnet_core.errors import InvalidInputError
from regnet_core.training.checkpoint import load_checkpoint, restore_optimiser, save_checkpoint
from regnet_core.training.trainer import CHECKPOINT, WEIGHTS, Report

_RISE = 0.05
"""Over this share of the run the learning rate rises; then it falls along a cosine."""


@dataclass(frozen=True)
class BaselineRecipe:
    """One training run.

    Raises:
        InvalidInputError: a number is out of range.
    """

    steps: int
    """Batches in all."""
    batch: int
    """Examples in a batch: hands for the classifiers, views for S4G."""
    learning_rate: float
    """The highest."""
    weight_decay: float = 1e-4
    clip: float = 5.0
    """Largest norm of the gradient."""
    seed: int = 0

    def __post_init__(self) -> None:
        check_range("steps", self.steps, 1)
        check_range("batch", self.batch, 2)
        check_range("learning_rate", self.learning_rate, 1e-8, 1.0)
        check_range("weight_decay", self.weight_decay, 0.0, 1.0)
        check_range("clip", self.clip, 1e-6)
        check_range("seed", self.seed, 0)

    def to_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return dataclasses.asdict(self)


class Loss(NamedTuple):
    """Of one batch."""

    total: torch.Tensor
    """() with a gradient."""
    terms: dict[str, float]
    """What it is made of, by name."""


class Lesson(Protocol):
    """What a method learns."""

    @property
    def network(self) -> nn.Module:
        """What learns."""
        ...

    def losses(self, first: int, last: int) -> Iterator[Loss]:
        """The losses of the batches ``first`` to ``last - 1``, each computed when it is asked for.

        A batch depends on the recipe and its number alone.
        """
        ...

    def identity(self) -> dict[str, Any]:
        """What it learns from, as JSON has it: a run goes on with the same only."""
        ...

    def validate(self) -> dict[str, float]:
        """How good the network is on data that it does not learn from, by name; nothing where there are none."""
        ...


@dataclass
class BaselineTrainer:
    """One run, new or continued.

    Attributes:
        name: of the method.
        lesson: what it learns.
        recipe: how.
        out: folder of checkpoint and weights.
        save_every: time between checkpoints [s].
        stop_after: time after which to save and stop [s].
        validate_every: steps between validations.
        report: called with the number of steps done and numbers by name.
        step: steps done.
    """

    name: str
    lesson: Lesson
    recipe: BaselineRecipe
    out: Path
    save_every: float = 180.0
    stop_after: float = math.inf
    validate_every: int = 500
    report: Report = lambda step, values: None
    step: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        self.network = self.lesson.network
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=self.recipe.learning_rate, weight_decay=self.recipe.weight_decay
        )

    @property
    def checkpoint(self) -> Path:
        """Where the run is saved."""
        return self.out / CHECKPOINT

    def resume(self) -> None:
        """Go on from the checkpoint.

        Raises:
            InvalidInputError: there is none, or it is of another run.
        """
        saved = load_checkpoint(self.checkpoint)
        here, there = _flat(self._identity()), _flat(saved.state["run"])
        different = [
            f"{key} was {there.get(key)!r} and is {here.get(key)!r}"
            for key in sorted({*here, *there})
            if here.get(key) != there.get(key)
        ]
        if different:
            raise InvalidInputError(f"'{self.checkpoint}' is of another run: {', '.join(different)}")
        self.network.load_state_dict(saved.model)
        restore_optimiser(self._optimiser, saved.optimiser)
        self.step = int(saved.state["step"])

    def train(self) -> None:
        """Train to the end of the recipe, or to the end of the time."""
        began = saved = time.monotonic()
        self.network.train()
        for loss in self.lesson.losses(self.step, self.recipe.steps):
            values = self._learn(loss)
            self.step += 1
            self.report(self.step, values)
            if self.step % self.validate_every == 0 or self.step == self.recipe.steps:
                self._validate()
            now = time.monotonic()
            if now - began > self.stop_after:
                break
            if now - saved > self.save_every:
                self.save()
                saved = now
        self.save()
        save_weights(self.out / WEIGHTS, self.name, self.network, {"step": self.step, **self._identity()})

    def save(self) -> None:
        """Write the checkpoint."""
        save_checkpoint(self.checkpoint, self.network, self._optimiser, {"step": self.step, "run": self._identity()})

    def learning_rate(self) -> float:
        """Of the next step."""
        done, highest = self.step / self.recipe.steps, self.recipe.learning_rate
        if done < _RISE:
            return highest * (0.05 + 0.95 * done / _RISE)
        return highest * max(0.5 * (1.0 + math.cos(math.pi * (done - _RISE) / (1.0 - _RISE))), 1e-3)

    def _learn(self, loss: Loss) -> dict[str, float]:
        rate = self.learning_rate()
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        self._optimiser.zero_grad(set_to_none=True)
        loss.total.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.clip)
        if torch.isfinite(norm):
            self._optimiser.step()
        return {"total": loss.total.item(), **loss.terms, "gradient": float(norm), "learning_rate": rate}

    def _validate(self) -> None:
        self.network.eval()
        with torch.no_grad():
            found = self.lesson.validate()
        self.network.train()
        if found:
            self.report(self.step, {f"validation/{name}": value for name, value in found.items()})

    def _identity(self) -> dict[str, Any]:
        """What a run must have in common with its checkpoint, as JSON gives it back."""
        identity = {"network": self.name, "recipe": self.recipe.to_dict(), **self.lesson.identity()}
        back: dict[str, Any] = json.loads(json.dumps(identity))
        return back


def _flat(document: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of a JSON document by the path of their keys."""
    found: dict[str, Any] = {}
    for key, value in document.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found
