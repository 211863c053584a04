"""What a batch teaches the three stages."""

from __future__ import annotations

from typing import NamedTuple

import torch

from regnet_core.data.dataset import GraspBatch
from regnet_core.nn.anchors import RefineCoder
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.losses import StageLoss, score_loss, stage_loss
from regnet_core.nn.matching import LabelledGrasps, Matcher, proposal_targets, region_targets
from regnet_core.nn.network import RegNet
from regnet_core.training.recipe import Recipe

_LEAST_WEIGHT = 0.02
"""Weight of an object's point without any confidence, when positive points are drawn."""


class StepLosses(NamedTuple):
    """The losses of a batch."""

    total: torch.Tensor
    """()."""
    score: torch.Tensor
    """() of the Score Network, eq. (2)."""
    grasp: StageLoss
    """Of the Grasp Region Network, eq. (3)."""
    refined: StageLoss | None
    """Of the Refine Network, eq. (4); None where there is none."""

    def scalars(self) -> dict[str, float]:
        """Every number by name."""
        values = {"total": self.total.item(), "score": self.score.item()}
        for stage, loss in (("grasp", self.grasp), ("refined", self.refined)):
            if loss is not None:
                values |= {f"{stage}/{name}": value.item() for name, value in loss._asdict().items()}
        return values


def batch_losses(network: RegNet, batch: GraspBatch, recipe: Recipe, generator: torch.Generator) -> StepLosses:
    """Run the network in training and compare it with the labels.

    Args:
        network: in training mode.
        batch: of the data set, on the network's device.
        recipe: of the run.
        generator: draws the positive points that the later stages learn at.
    """
    clouds = Clouds.stacked(batch.points, batch.width, batch.colors)
    positives = draw_positives(batch, recipe.regions, generator)
    proposed = network.propose(clouds, positives=positives)
    matcher = Matcher(recipe.matching)
    grasps = LabelledGrasps.of(batch, recipe.matching)
    regions = proposed.regions
    objects = batch.object_index.reshape(-1)[regions.source]
    anchors = regions.points.new_tensor(network.config.coder.anchors)
    match = matcher.match_regions(regions.points, regions.cloud, anchors, grasps, objects)
    grasp = stage_loss(proposed.anchors, region_targets(network.coder, regions.points, match, grasps), recipe.losses)
    score = score_loss(proposed.confidence, batch.confidence.reshape(-1), recipe.losses)
    total, refined = score + grasp.total, None
    if network.refinement is not None:
        candidates = network.best_anchors(proposed)
        prediction = network.refine(candidates, proposed, clouds).prediction
        scene = regions.cloud[candidates.region]
        target = proposal_targets(
            RefineCoder(network.config.coder),
            candidates.pose,
            matcher.match_proposals(candidates.pose, scene, grasps),
            grasps,
        )
        refined = stage_loss(prediction, target, recipe.losses)
        total = total + refined.total
    return StepLosses(total, score, grasp, refined)


def draw_positives(batch: GraspBatch, count: int, generator: torch.Generator) -> torch.Tensor:
    """Rows (B * count,) of the batch's points, cloud after cloud, drawn by their confidence.

    Points of objects without any confidence are drawn now and then, so that regions without a grasp are learnt as well.
    """
    weights = batch.confidence + _LEAST_WEIGHT * (batch.object_index >= 0) + 1e-6
    rows = torch.multinomial(weights.cpu(), count, replacement=True, generator=generator)
    start = torch.arange(len(weights))[:, None] * weights.shape[1]
    return (rows + start).reshape(-1).to(batch.points.device)
