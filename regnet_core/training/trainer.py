"""The training loop: resumable, and reproducible from its recipe."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from regnet_core.data.dataset import GraspBatch, GraspDataset, GraspSample, collate
from regnet_core.errors import InvalidInputError, ModelError
from regnet_core.evaluation.metrics import MeanMetrics, mean_metrics
from regnet_core.nn.files import load_network, save_network
from regnet_core.nn.network import RegNet
from regnet_core.nn.precision import autocast
from regnet_core.nn.zoo import network_config
from regnet_core.training.augmentation import AugmentedDataset
from regnet_core.training.checkpoint import load_checkpoint, restore_optimiser, save_checkpoint
from regnet_core.training.distributed import Group
from regnet_core.training.judging import BatchJudge
from regnet_core.training.recipe import Recipe
from regnet_core.training.step import batch_losses
from regnet_core.training.validation import validate

CHECKPOINT = "checkpoint.safetensors"
WEIGHTS = "weights.safetensors"
"""The network alone, in half precision: what detectors load."""


@dataclass(frozen=True)
class Run:
    """Where a run finds and leaves things.

    Attributes:
        network: a name of nn/zoo.py.
        data: folder of the training data.
        out: folder of checkpoints and logs.
        validation: folder of the validation data; none to go without.
        device: where to train.
        workers: processes that read data.
        save_every: time between checkpoints [s].
        validate_every: steps between validations.
        validation_samples: views judged in each.
        stop_after: time after which to save and stop [s].
        group: the processes that train together.
        start: weights of the same kind of network to start from; random ones when None.
    """

    network: str
    data: Path
    out: Path
    validation: Path | None = None
    device: str = "cpu"
    workers: int = 1
    save_every: float = 180.0
    validate_every: int = 1000
    validation_samples: int = 16
    stop_after: float = math.inf
    group: Group = Group()
    start: Path | None = None


Report = Callable[[int, dict[str, float]], None]
"""Called with the number of steps done and numbers by name."""


@dataclass
class Trainer:
    """One run, new or continued."""

    run: Run
    recipe: Recipe
    report: Report = lambda step, values: None
    network: RegNet = field(init=False)
    step: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        self._part = self.run.group.part_of(self.recipe.batch)
        torch.manual_seed(self.recipe.seed)
        self.device = torch.device(self.run.device)
        config = network_config(self.run.network)
        self.network = RegNet(config.coarser(self.recipe.detail)).to(self.device)
        if self.run.start is not None:
            self._start_from(self.run.start)
        self.dataset = GraspDataset(
            self.run.data,
            self.recipe.points,
            widths=self.recipe.widths or None,
            seed=self.recipe.seed,
            between=0.0 if self.recipe.widths else self.recipe.between,
        )
        self._judge = BatchJudge(self.dataset.archive) if self.recipe.judged else None
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=self.recipe.learning_rate, weight_decay=self.recipe.weight_decay
        )

    @property
    def checkpoint(self) -> Path:
        """Where the run is saved."""
        return self.run.out / CHECKPOINT

    def resume(self) -> None:
        """Go on from the checkpoint.

        Raises:
            InvalidInputError: there is none, or it is of another run.
        """
        saved = load_checkpoint(self.checkpoint)
        if saved.state["run"] != self._identity():
            different = _differences(saved.state["run"], self._identity())
            raise InvalidInputError(f"'{self.checkpoint}' is of another run: {', '.join(different)}")
        self.network.load_state_dict(saved.model)
        restore_optimiser(self._optimiser, saved.optimiser)
        self.step = int(saved.state["step"])

    def train(self) -> None:
        """Train to the end of the recipe, or to the end of the time."""
        began = saved = time.monotonic()
        group = self.run.group
        self.network.train()
        for batch in self._batches():
            self.report(self.step + 1, self._step(batch))
            self.step += 1
            if self.run.validation is not None and self.step % self.run.validate_every == 0 and group.leads:
                self.report(self.step, _named(self.validate()))
            now = time.monotonic()
            if group.any(now - saved > self.run.save_every):
                self.save()
                saved = now
            if group.any(now - began > self.run.stop_after):
                break
        self.save()
        if group.leads:
            save_network(self.run.out / WEIGHTS, self.network, {"step": self.step, **self._identity()})

    def validate(self) -> MeanMetrics:
        """The metrics on samples spread over the validation data.

        Raises:
            InvalidInputError: the run has no validation data.
        """
        if self.run.validation is None:
            raise InvalidInputError("this run has no validation data: give some with --validation")
        dataset = GraspDataset(self.run.validation, self.recipe.points, widths=self.recipe.widths or None)
        samples = np.linspace(0, len(dataset) - 1, min(self.run.validation_samples, len(dataset))).round().astype(int)
        return mean_metrics(validate(self.network, dataset, samples.tolist(), self.device))

    def save(self) -> None:
        """Write the checkpoint."""
        self.run.group.average_statistics(self.network)
        if not self.run.group.leads:
            return
        state: dict[str, Any] = {"step": self.step, "run": self._identity()}
        save_checkpoint(self.checkpoint, self.network, self._optimiser, state)

    def learning_rate(self) -> float:
        """Of the next step."""
        done, recipe = self.step / self.recipe.steps, self.recipe
        if recipe.schedule == "paper":
            return recipe.learning_rate * 0.5 ** int(3.0 * done)
        rise = 0.05
        if done < rise:
            return recipe.learning_rate * (0.05 + 0.95 * done / rise)
        return recipe.learning_rate * max(0.5 * (1.0 + math.cos(math.pi * (done - rise) / (1.0 - rise))), 1e-3)

    def _start_from(self, path: Path) -> None:
        """Raises: ModelError, where the weights are of another kind of network."""
        trained, _ = load_network(path)
        try:
            self.network.load_state_dict(trained.state_dict())
        except RuntimeError as error:
            name = trained.config.name
            raise ModelError(f"'{path}' is of '{name}', and cannot start '{self.run.network}'") from error

    def _step(self, batch: GraspBatch) -> dict[str, float]:
        for group in self._optimiser.param_groups:
            group["lr"] = self.learning_rate()
        seed = (self.recipe.seed * 1_000_003 + self.step) * 1009 + self.run.group.rank
        generator = torch.Generator().manual_seed(seed)
        self._optimiser.zero_grad(set_to_none=True)
        with autocast(self.device):
            losses = batch_losses(self.network, batch.to(self.device), self.recipe, generator, self._judge)
        losses.total.backward()
        self.run.group.average_gradients(self.network)
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.clip)
        if torch.isfinite(norm):
            self._optimiser.step()
        return {**losses.scalars(), "gradient": float(norm), "learning_rate": self.learning_rate()}

    def _batches(self) -> Iterator[GraspBatch]:
        """The batches that are still to come; each depends on its number alone."""
        per_epoch = max(len(self.dataset) // self.recipe.batch, 1)
        while self.step < self.recipe.steps:
            epoch, done = divmod(self.step, per_epoch)
            dataset = AugmentedDataset(self.dataset, self.recipe.augmentation, self.recipe.seed)
            dataset.set_epoch(epoch)
            order = np.random.default_rng([self.recipe.seed, epoch]).permutation(len(dataset))
            rows = np.resize(order, per_epoch * self.recipe.batch).reshape(per_epoch, -1)[done:]
            rows = rows[: self.recipe.steps - self.step, self._part]
            yield from _loader(dataset, rows, self.run.workers)

    def _identity(self) -> dict[str, Any]:
        """What a run must have in common with its checkpoint, as JSON gives it back."""
        identity = {
            "network": self.run.network,
            "recipe": self.recipe.to_dict(),
            "data": {
                "settings": self.dataset.archive.manifest.settings.to_dict(),
                "scenes": len(self.dataset.archive),
            },
        }
        if self.run.start is not None:
            identity["start"] = hashlib.sha256(self.run.start.read_bytes()).hexdigest()
        back: dict[str, Any] = json.loads(json.dumps(identity))
        return back


class _InOrder(Sampler[list[int]]):
    """Batches that were drawn before."""

    def __init__(self, rows: np.ndarray) -> None:
        self._rows = rows

    def __iter__(self) -> Iterator[list[int]]:
        return iter(self._rows.tolist())

    def __len__(self) -> int:
        return len(self._rows)


def _loader(dataset: Dataset[GraspSample], rows: np.ndarray, workers: int) -> DataLoader[GraspBatch]:
    return DataLoader(
        dataset,  # type: ignore[arg-type]
        batch_sampler=_InOrder(rows),
        num_workers=workers,
        collate_fn=collate,
        # Spawned: the threads of torch and numba do not survive a fork.
        multiprocessing_context="spawn" if workers else None,
    )


def _differences(there: Any, here: Any, name: str = "") -> list[str]:
    """Where two JSON documents differ, one line for each value."""
    if isinstance(there, dict) and isinstance(here, dict):
        keys = sorted({*there, *here})
        return [
            line for key in keys for line in _differences(there.get(key), here.get(key), f"{name}.{key}".strip("."))
        ]
    return [] if there == here else [f"{name} was {there!r} and is {here!r}"]


def _named(metrics: MeanMetrics) -> dict[str, float]:
    return {
        "validation/CFR": metrics.cfr,
        "validation/AS": metrics.antipodal,
        "validation/AS with C": metrics.antipodal_with_collisions,
        "validation/TCR": metrics.coverage,
    }
