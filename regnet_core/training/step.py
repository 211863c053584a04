"""What a batch teaches the three stages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch

from regnet_core.data.dataset import GraspBatch
from regnet_core.nn.anchors import Pose
from regnet_core.nn.clouds import Clouds, with_shapes
from regnet_core.nn.losses import StageLoss, score_loss, stage_loss
from regnet_core.nn.matching import LabelledGrasps, Matcher, proposal_targets, region_targets
from regnet_core.nn.network import RegNet
from regnet_core.nn.results import Candidates, Proposed, Refined
from regnet_core.training.recipe import Recipe

_LEAST_WEIGHT, _LEAST_ON_TABLE = 0.02, 0.002
"""Weights of points without any confidence when positive points are drawn: of objects and fixtures, and of the rest."""
_FIXTURE = -2


Judge = Callable[[GraspBatch, Pose, torch.Tensor], torch.Tensor]
"""Given a batch, grasps (M) in it and their samples (M,), says how good they truly are (M,): judging.py."""


class StepLosses(NamedTuple):
    """The losses of a batch."""

    total: torch.Tensor
    """()."""
    score: torch.Tensor
    """() of the Score Network, eq. (2)."""
    grasp: StageLoss
    """Of the Grasp Region Network, eq. (3)."""
    refined: tuple[StageLoss, ...]
    """Of each pass of the Refine Network, eq. (4); none where there is no such network."""
    quality: torch.Tensor
    """(): what the network's final grasps of this batch are worth, where they are judged; NaN where not."""

    def scalars(self) -> dict[str, float]:
        """Every number by name."""
        values = {"total": self.total.item(), "score": self.score.item(), "judged": self.quality.item()}
        stages = {"grasp": self.grasp, **{f"refined {i}": loss for i, loss in enumerate(self.refined, 1)}}
        for stage, loss in stages.items():
            values |= {f"{stage}/{name}": value.item() for name, value in loss._asdict().items()}
        return values


def batch_losses(
    network: RegNet, batch: GraspBatch, recipe: Recipe, generator: torch.Generator, judge: Judge | None = None
) -> StepLosses:
    """Run the network in training and compare it with the labels.

    Args:
        network: in training mode.
        batch: of the data set, on the network's device.
        recipe: of the run.
        generator: draws the positive points that the later stages learn at.
        judge: of the network's own proposals; without one quality is that of the matched labels.
    """
    clouds = with_shapes(Clouds.stacked(batch.points, batch.width, batch.colors), network.config)
    positives = draw_positives(batch, recipe.regions, generator)
    proposed = network.propose(clouds, positives=positives)
    lesson = _Lesson(network, batch, recipe, judge, LabelledGrasps.of(batch, recipe.matching))
    score = score_loss(proposed.confidence, batch.confidence.reshape(-1), recipe.losses)
    refinement = network.config.refinement
    candidates = network.best_anchors(proposed, 1 if refinement is None else recipe.candidates)
    grasp, quality = lesson.of_anchors(proposed, candidates)
    total, passes = score + grasp.total, []
    for _ in range(0 if refinement is None else refinement.passes):
        refined = network.refine(candidates, proposed, clouds)
        loss, quality = lesson.of_refined(proposed, candidates, refined)
        passes.append(loss)
        total = total + loss.total
        candidates = network.best_refined(candidates, refined)
    return StepLosses(total, score, grasp, tuple(passes), quality)


@dataclass(frozen=True)
class _Lesson:
    """What the proposals of a batch should have been."""

    network: RegNet
    batch: GraspBatch
    recipe: Recipe
    judge: Judge | None
    grasps: LabelledGrasps

    def of_anchors(self, proposed: Proposed, candidates: Candidates) -> tuple[StageLoss, torch.Tensor]:
        """Loss of the Grasp Region Network, and what the best of its proposals are worth on average."""
        regions, matcher = proposed.regions, Matcher(self.recipe.matching)
        objects = self.batch.object_index.reshape(-1)[regions.source]
        anchors = regions.points.new_tensor(self.network.config.coder.anchors)
        match = matcher.match_regions(regions.points, regions.cloud, anchors, self.grasps, objects)
        target = region_targets(self.network.coder, regions.points, match, self.grasps)
        worth = self._worth(candidates.pose, regions.cloud[candidates.region])
        if worth is not None:
            quality = torch.full_like(target.quality, math.nan)
            quality[candidates.region, candidates.anchor] = worth
            target = target._replace(quality=quality)
        return stage_loss(proposed.anchors, target, self.recipe.losses), _mean(worth)

    def of_refined(
        self, proposed: Proposed, candidates: Candidates, refined: Refined
    ) -> tuple[StageLoss, torch.Tensor]:
        """Loss of a pass of the Refine Network, and what the refined proposals are worth on average."""
        matcher, scene = Matcher(self.recipe.matching), proposed.regions.cloud[candidates.region]
        match = matcher.match_proposals(candidates.pose, scene, self.grasps)
        target = proposal_targets(self.network.refine_coder, candidates.pose, match, self.grasps)
        worth = self._worth(self.network.refined_pose(candidates, refined), scene)
        if worth is not None:
            target = target._replace(quality=worth.to(target.quality.dtype))
        return stage_loss(refined.prediction, target, self.recipe.losses), _mean(worth)

    def _worth(self, pose: Pose, scene: torch.Tensor) -> torch.Tensor | None:
        return None if self.judge is None else self.judge(self.batch, pose, scene)


def _mean(worth: torch.Tensor | None) -> torch.Tensor:
    return torch.tensor(math.nan) if worth is None else worth.mean()


def draw_positives(batch: GraspBatch, count: int, generator: torch.Generator) -> torch.Tensor:
    """Rows (B * count,) of the batch's points, cloud after cloud, drawn by their confidence.

    Points without any confidence are drawn now and then, so that regions without a grasp are learnt as well: the wall
    of a bin looks just like something to hold.
    """
    solid = (batch.object_index >= 0) | (batch.object_index == _FIXTURE)
    weights = batch.confidence + torch.where(solid, _LEAST_WEIGHT, _LEAST_ON_TABLE)
    rows = torch.multinomial(weights.cpu(), count, replacement=True, generator=generator)
    start = torch.arange(len(weights))[:, None] * weights.shape[1]
    return (rows + start).reshape(-1).to(batch.points.device)
