"""How a network is trained: everything that a run can be repeated from."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from regnet_core.checks import check_range
from regnet_core.errors import InvalidInputError
from regnet_core.nn.losses import LossConfig
from regnet_core.nn.matching import MatchConfig


@dataclass(frozen=True)
class Augmentation:
    """Changes of each sample, drawn anew every time.

    Raises:
        InvalidInputError: a number is out of range.
    """

    rotation: bool = True
    """Whether the scene is turned by any angle about the vertical through the table's middle."""
    tilt: float = 0.015
    """Standard deviation of the error of "up", about a random level axis [rad]."""
    jitter: float = 0.0005
    """Standard deviation of an error of every coordinate of every point [m]."""
    dropout: float = 0.3
    """Most points that are lost, as a share; the actual one is uniform below it."""

    def __post_init__(self) -> None:
        check_range("tilt", self.tilt, 0.0, 0.5, "rad")
        check_range("jitter", self.jitter, 0.0, 0.05, "m")
        check_range("dropout", self.dropout, 0.0, 0.95)


@dataclass(frozen=True)
class Recipe:
    """One training run.

    Raises:
        InvalidInputError: a number is out of range.
    """

    steps: int = 20_000
    """Batches in all."""
    batch: int = 6
    """Views in a batch."""
    points: int = 25600
    """Points drawn from a view."""
    detail: float = 1.0
    """Share of the network's centroids, and of their neighbours, that it has in training. The layers do not depend on
    it, and most steps can be learnt coarsely: in a run with less of both, and of the points, that another starts from.
    """
    regions: int = 128
    """Positive points of each view that the second and third stage learn at."""
    candidates: int = 2
    """Anchors of each of their regions whose poses the third stage learns from, the likeliest ones. In detection it
    refines the likeliest one."""
    between: float = 0.5
    """Share of the samples that are for a width between those of the labels, drawn anew every time."""
    widths: tuple[float, ...] = ()
    """Only these of the data set's widths, and none between them [m]; empty: all of them."""
    judged: bool = True
    """Whether quality is learnt from the network's own proposals, judged on the true meshes; otherwise, as in the
    paper, from the labelled grasps that positive proposals are matched with."""
    learning_rate: float = 2e-3
    """The highest; the paper has 0.005."""
    schedule: Literal["one-cycle", "paper"] = "one-cycle"
    """one-cycle: up over the first twentieth, then down along a cosine. paper: halved at every third of the run."""
    weight_decay: float = 1e-4
    clip: float = 5.0
    """Largest norm of the gradient."""
    seed: int = 0
    augmentation: Augmentation = field(default_factory=Augmentation)
    losses: LossConfig = field(default_factory=LossConfig)
    matching: MatchConfig = field(default_factory=MatchConfig)

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "points", "regions", "candidates"):
            check_range(name, getattr(self, name), 1)
        check_range("detail", self.detail, 1e-3, 1.0)
        check_range("between", self.between, 0.0, 1.0)
        check_range("learning_rate", self.learning_rate, 1e-8, 1.0)
        check_range("weight_decay", self.weight_decay, 0.0, 1.0)
        check_range("clip", self.clip, 1e-6)
        check_range("seed", self.seed, 0)
        if self.schedule not in ("one-cycle", "paper"):
            raise InvalidInputError(f"schedule must be 'one-cycle' or 'paper', got {self.schedule!r}")

    def to_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Recipe:
        """Reads what ``to_dict`` gave.

        Raises:
            InvalidInputError: an entry is unknown or out of range.
        """
        values = dict(document)
        try:
            values["augmentation"] = Augmentation(**values.get("augmentation", {}))
            values["losses"] = LossConfig(**values.get("losses", {}))
            values["matching"] = MatchConfig(**values.get("matching", {}))
            values["widths"] = tuple(values.get("widths", ()))
            return cls(**values)
        except TypeError as error:
            raise InvalidInputError(f"this is no recipe: {error}") from error
