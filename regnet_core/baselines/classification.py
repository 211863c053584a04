"""Methods that sample grasp candidates and let a network tell the good ones: GPD and PointNetGPD."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import nn

from regnet_core.baselines.closing_area import ClosingAreas, closing_areas
from regnet_core.baselines.gpg import GpgConfig, GpgSampler
from regnet_core.checks import check_range
from regnet_core.geometry import Array, Mask
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.nn.precision import autocast
from regnet_core.proposer import Proposals
from regnet_core.scene import Scene


class GraspClassifier(nn.Module):
    """A network that tells good hands from others by what is in their closing areas."""

    name: str
    """The method's."""
    good_score: float
    """What it learns to call good: a hand that is free and whose true s_q is at least this."""
    least_points = 1
    """Hands with fewer points in their areas cannot be told, and are no grasps."""
    most_points = 1024
    """Of more points in an area, so many drawn at random are looked at."""

    @abstractmethod
    def forward(self, areas: ClosingAreas) -> torch.Tensor:
        """Logits (G, 2) of the classes other and good, for the areas of G hands."""


@dataclass(frozen=True)
class ClassificationConfig:
    """What becomes of the candidates; the numbers are those of the REGNet V2 paper.

    Raises:
        InvalidInputError: a number is out of range.
    """

    threshold: float = 0.6
    """Hands whose probability of being good is above this are grasps."""
    sampler: GpgConfig = field(default_factory=GpgConfig)

    def __post_init__(self) -> None:
        check_range("threshold", self.threshold, 0.0, 1.0)


class ClassifierProposer:
    """A sampler of candidates and a classifier as a method of ``GraspDetector``; quality is the probability of good."""

    def __init__(
        self, network: GraspClassifier, device: str = "cpu", config: ClassificationConfig | None = None
    ) -> None:
        """Args:
        network: trained; it is put in evaluation mode.
        device: where it runs; candidates are sampled on the CPU.
        config: the paper's numbers unless given.
        """
        self.device = torch.device(device)
        self.network = network.to(self.device).eval()
        self.config = config or ClassificationConfig()
        self.name = network.name
        self._sampler = GpgSampler(self.config.sampler)

    def propose(self, scene: Scene, gripper: Gripper, focus: Mask | None, rng: np.random.Generator) -> Proposals:
        """The candidates at focused points that are good, the jaw open at W."""
        found = self._sampler.sample(scene, gripper, focus, rng)
        areas = areas_in(scene, found.rotation, found.translation, gripper, self.network.most_points, rng)
        told = np.flatnonzero(areas.counts >= self.network.least_points)
        good = self._probability(areas.take(told))
        keep = good > self.config.threshold
        rows, quality = told[keep], good[keep]
        width = np.full(len(rows), gripper.width)
        return Proposals(Grasps.from_poses(found.rotation[rows], found.translation[rows], width, quality), found.tried)

    @torch.inference_mode()
    def _probability(self, areas: ClosingAreas) -> Array:
        """(G,): how likely each hand is good."""
        if len(areas) == 0:
            return np.zeros(0)
        with autocast(self.device):
            logits = self.network(areas)
        return logits.double().softmax(dim=1)[:, 1].cpu().numpy()  # type: ignore[no-any-return]


def areas_in(
    scene: Scene, rotation: Array, translation: Array, gripper: Gripper, most: int, rng: np.random.Generator
) -> ClosingAreas:
    """The closing areas of hands (G, 3, 3), (G, 3) in the seen surface of the objects; at most ``most`` points each."""
    seen = rng.permutation(np.flatnonzero(scene.objects.observed))
    return closing_areas(rotation, translation, gripper, scene.objects.points[seen], scene.objects.normals[seen], most)
