"""The three stages of REGNet V2 put together: Score Network, Grasp Region Network, Refine Network."""

from __future__ import annotations

import torch
from torch import nn

from regnet_core.errors import ModelError
from regnet_core.gripper import Gripper
from regnet_core.nn.anchors import GraspCoder, Pose, RefineCoder
from regnet_core.nn.backbone import Backbone
from regnet_core.nn.clouds import Clouds, buckets_of, with_shapes
from regnet_core.nn.config import NetworkConfig
from regnet_core.nn.heads import GraspHead, ScoreHead
from regnet_core.nn.hierarchy import Hierarchy, build_hierarchy
from regnet_core.nn.layers import Mlp
from regnet_core.nn.point_features import PointFeatures
from regnet_core.nn.refinement import RefineNetwork
from regnet_core.nn.regions import candidate_points, pool_regions, regions_at, select_regions
from regnet_core.nn.results import (
    Candidates,
    Output,
    Proposed,
    Refined,
    StagePrediction,
    best_of_clouds,
    best_of_regions,
    expected_quality,
    refined_quality,
)


class RegNet(nn.Module):
    """REGNet V2 or one of its variants."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.coder, self.refine_coder = GraspCoder(config.coder), RefineCoder(config.coder)
        self.backbone = Backbone(config)
        self.score = ScoreHead(config)
        self.grasp = GraspHead(config)
        self.refinement = None if config.refinement is None else RefineNetwork(config, config.refinement)

    def use_bytes(self) -> None:
        """Compute with bytes (int8.py) on a CPU, where no gradients are wanted, until the mode changes."""
        for module in self.modules():
            if isinstance(module, Mlp):
                module.use_bytes()

    def forward(
        self,
        clouds: Clouds,
        gripper: Gripper | None = None,
        hierarchy: Hierarchy | None = None,
        eligible: torch.Tensor | None = None,
    ) -> Output:
        """All stages.

        Args:
            clouds: B clouds; the grippers' widths come with them.
            gripper: depth and height of the hand; ``Gripper()`` when not given.
            hierarchy: of the clouds, where it was made ahead.
            eligible: (N,) which points may become positive; all of them when None.
        """
        if hierarchy is None and clouds.points.device.type == "cpu" and not torch.is_grad_enabled():
            buckets = buckets_of(clouds)
            clouds = with_shapes(clouds, self.config, buckets)
            hierarchy = build_hierarchy(clouds, self.config, buckets, eligible is None)
        else:
            clouds = with_shapes(clouds, self.config)
        proposed = self.propose(clouds, hierarchy, eligible=eligible)
        if self.config.refinement is None:
            return Output(proposed, self.best_anchors(proposed), None)
        candidates = self.first_candidates(proposed)
        refined = self.refine(candidates, proposed, clouds, gripper)
        for number in range(1, self.config.refinement.passes):
            candidates = self.next_candidates(candidates, refined, proposed, number)
            refined = self.refine(candidates, proposed, clouds, gripper)
        return Output(proposed, candidates, refined)

    def propose(
        self,
        clouds: Clouds,
        hierarchy: Hierarchy | None = None,
        positives: torch.Tensor | None = None,
        eligible: torch.Tensor | None = None,
    ) -> Proposed:
        """The first two stages.

        Args:
            clouds: B clouds.
            hierarchy: of the clouds, where it was made ahead.
            positives: (R,) rows of the clouds' points, in the order of the clouds, to take instead of the most
                confident ones: for training.
            eligible: (N,) which points may be among the most confident ones; all of them when None. The confidence of
                others is then not computed, but -infinity.
        """
        clouds = with_shapes(clouds, self.config)
        cfg, hierarchy = self.config, hierarchy or build_hierarchy(clouds, self.config)
        coarse = self.backbone.coarse(clouds, hierarchy)
        of_all = eligible is None or torch.is_grad_enabled() or clouds.points.device.type != "cpu"
        points = PointFeatures(self.backbone, self._carry, coarse, of_all)
        if positives is None:
            candidates = candidate_points(clouds, hierarchy, cfg.layer, eligible)
            confidence = self.score(points.values) if eligible is None else self._confidence(points, candidates)
            regions = select_regions(confidence, candidates, clouds, cfg.positives, cfg.least_confidence)
        else:
            confidence = self.score(points.values)
            regions = regions_at(positives, clouds)
        pooled = pool_regions(points, regions, clouds, hierarchy, cfg.region)
        anchors: StagePrediction = self.grasp(pooled, self.score.mlp)
        return Proposed(hierarchy, points, confidence, regions, pooled, anchors)

    def _carry(self, features: torch.Tensor) -> torch.Tensor | None:
        """What the points' features come to in the Refine Network."""
        carried: torch.Tensor | None = None if self.refinement is None else self.refinement.carried(features)
        return carried

    def _confidence(self, points: PointFeatures, candidates: list[torch.Tensor]) -> torch.Tensor:
        """(N,): that of the candidates alone; the others, which cannot become positive, have none."""
        rows = torch.cat(candidates)
        points.need(rows)
        some = self.score(points.values.index_select(0, rows))
        return some.new_full((len(points.values),), -torch.inf).index_copy(0, rows, some)

    @torch.no_grad()
    def best_anchors(self, proposed: Proposed, count: int = 1) -> Candidates:
        """The proposals (R * count,) of each region's best anchors, region after region."""
        count = min(count, self.config.anchors)
        best = expected_quality(proposed.anchors).topk(count, dim=1).indices
        region = torch.arange(len(best), device=best.device).repeat_interleave(count)
        best = best.flatten()
        residual = proposed.anchors.residual[region, best]
        return Candidates(self.coder.decode(proposed.regions.points[region], best, residual), region, best)

    @torch.no_grad()
    def refined_pose(self, candidates: Candidates, refined: Refined) -> Pose:
        """What the third stage makes of the proposals (G,)."""
        return self.refine_coder.decode(candidates.pose, refined.prediction.residual)

    @torch.no_grad()
    def best_refined(self, candidates: Candidates, refined: Refined) -> Candidates:
        """The refined proposal (R,) of each region that is expected to be the best, to go on from."""
        rows = best_of_regions(candidates, refined)
        return candidates._replace(pose=self.refined_pose(candidates, refined)).take(rows)

    def first_candidates(self, proposed: Proposed) -> Candidates:
        """What goes into the first pass of the refinement: the best anchor of each region, of the best regions."""
        candidates = self.best_anchors(proposed)
        quality = expected_quality(proposed.anchors)[candidates.region, candidates.anchor]
        return self._most_promising(candidates, quality, proposed, 0)

    def next_candidates(self, candidates: Candidates, refined: Refined, proposed: Proposed, number: int) -> Candidates:
        """What goes into the refinement's pass of that number: the best of what the pass before made."""
        quality = refined_quality(refined)[best_of_regions(candidates, refined)]
        return self._most_promising(self.best_refined(candidates, refined), quality, proposed, number)

    def _most_promising(
        self, candidates: Candidates, quality: torch.Tensor, proposed: Proposed, number: int
    ) -> Candidates:
        refinement = self.config.refinement
        if refinement is None or not refinement.proposals:
            return candidates
        return best_of_clouds(candidates, quality, proposed.regions, refinement.proposals[number])

    def refine(
        self, candidates: Candidates, proposed: Proposed, clouds: Clouds, gripper: Gripper | None = None
    ) -> Refined:
        """The third stage, for any proposals, which must come in the order of their clouds.

        Raises:
            ModelError: the network has none.
        """
        if self.refinement is None:
            raise ModelError(f"the network '{self.config.name}' has no refinement")
        pose = Pose(candidates.pose.rotation.float(), candidates.pose.translation.float())
        refined: Refined = self.refinement(
            candidates._replace(pose=pose), proposed.regions, proposed.region_features, proposed.points,
            with_shapes(clouds, self.config), proposed.hierarchy, gripper or Gripper(),
        )  # fmt: skip
        return refined
