"""The Refine Network: proposals made better by a look at what is between their fingers.

The points of the closing area, moved into the grasp frame, go through a shared MLP, their maximum joins the features of
the region that the proposal comes from, and one linear layer says what to change. The published code keeps its points
in slots and mixes the slots with learnt weights, which depends on the order of the points; a maximum does not, and
needs no padding.
"""

from __future__ import annotations

import torch
from torch import nn

from regnet_core.gripper import Gripper
from regnet_core.nn.anchors import RESIDUALS, Pose
from regnet_core.nn.clouds import Clouds, width_feature
from regnet_core.nn.config import NetworkConfig, RefinementConfig
from regnet_core.nn.heads import RARE
from regnet_core.nn.hierarchy import Hierarchy
from regnet_core.nn.layers import Mlp, output_layer
from regnet_core.nn.point_features import PointFeatures
from regnet_core.nn.pooling import PooledMlp
from regnet_core.nn.results import Candidates, Refined, Regions, StagePrediction
from regnet_core.ops.box_query import Boxes, box_query
from regnet_core.ops.grasp_frame import seen_from_grasps
from regnet_core.ops.neighbourhoods import Neighbourhoods, joined

_UNIT = 0.03
"""Unit of positions in the closing area [m]: half the depth of the paper's gripper."""


class RefineNetwork(nn.Module):
    """Residuals, class and quality of proposals."""

    def __init__(self, config: NetworkConfig, refinement: RefinementConfig) -> None:
        super().__init__()
        self.config, self.refinement = config, refinement
        self.own_channels = 3 + config.point_channels
        carried = config.features if refinement.point_features else 0
        self.mlp = PooledMlp(self.own_channels + carried, refinement.channels)
        last = refinement.channels[-1] + config.features
        self.fusion = Mlp(last, refinement.fusion) if refinement.fusion else nn.Identity()
        last = refinement.fusion[-1] if refinement.fusion else last
        self.class_output = output_layer(last, 1, RARE)
        self.residual_output = output_layer(last, RESIDUALS + 1)

    def carried(self, features: torch.Tensor) -> torch.Tensor | None:
        """What features (N, C) of all points come to in the first layer (N, C_1), the same in every pass; None where
        points do not bring them along."""
        return self.mlp.carried(self.own_channels, features) if self.refinement.point_features else None

    def forward(
        self,
        candidates: Candidates,
        regions: Regions,
        region_features: torch.Tensor,
        points: PointFeatures,
        clouds: Clouds,
        hierarchy: Hierarchy,
        gripper: Gripper,
    ) -> Refined:
        """Args:
        candidates: G proposals, in the order of their clouds.
        regions: R regions.
        region_features: (R, C).
        points: the features of the clouds' points.
        clouds: the points and the grippers' widths.
        hierarchy: of the clouds.
        gripper: depth and height of the hand; its width is the clouds'.
        """
        cloud = regions.cloud[candidates.region]
        near = closing_points(candidates.pose, cloud, clouds, hierarchy, gripper, self.refinement)
        if self.refinement.point_features:
            points.need(near.indices)
        seen = self._seen(candidates.pose, cloud, near, points.carried, clouds)
        both = self.fusion(torch.cat([seen, region_features.index_select(0, candidates.region).to(seen.dtype)], dim=1))
        numbers = self.residual_output(both).float()
        logit = self.class_output(both).float().squeeze(1)
        prediction = StagePrediction(logit, numbers[:, :RESIDUALS], numbers[:, RESIDUALS])
        return Refined(prediction, near.counts > 0)

    def _seen(
        self, pose: Pose, cloud: torch.Tensor, near: Neighbourhoods, carried: torch.Tensor | None, clouds: Clouds
    ) -> torch.Tensor:
        """(G, C): the maximum over the points of each closing area."""

        def own(some: slice, near: Neighbourhoods) -> torch.Tensor:
            return self._own_features(Pose(*(value[some] for value in pose)), cloud[some], near, clouds)

        return self.mlp.pooled(own, self.own_channels, carried, near)

    def _own_features(self, pose: Pose, cloud: torch.Tensor, near: Neighbourhoods, clouds: Clouds) -> torch.Tensor:
        """(E, 3 + C): positions in the grasp frame, the width, the colours, and the local shapes in the grasp frame."""
        width = width_feature(clouds.width)[cloud, None] if self.config.width else None
        seen = seen_from_grasps(clouds.points, clouds.shapes, pose.rotation, pose.translation, near, _UNIT, width)
        if not self.config.colour or clouds.colors is None:
            return seen
        colours, first = clouds.colors.index_select(0, near.indices) * 2.0 - 1.0, 3 + int(self.config.width)
        return torch.cat([seen[:, :first], colours, seen[:, first:]], dim=1)


@torch.no_grad()
def closing_points(
    pose: Pose,
    cloud: torch.Tensor,
    clouds: Clouds,
    hierarchy: Hierarchy,
    gripper: Gripper,
    config: RefinementConfig,
) -> Neighbourhoods:
    """The points in the closing areas of G proposals, 0 < x < D, |y| < W/2, |z| < H/2, as rows of the clouds' points.

    Args:
        pose: (G, 3, 3) and (G, 3) [m].
        cloud: (G,), ascending.
        clouds: the points and W.
        hierarchy: of the clouds.
        gripper: D and H.
        config: the most points, and a margin around the area.
    """
    half_w = clouds.width[cloud] / 2
    zero, one = torch.zeros_like(half_w), torch.ones_like(half_w)
    upper = torch.stack([one * gripper.depth, half_w, one * gripper.height / 2], dim=1) + config.margin
    lower = torch.stack([zero, -half_w, -one * gripper.height / 2], dim=1) - config.margin
    bounds = torch.searchsorted(cloud, torch.arange(len(clouds.width) + 1, device=cloud.device)).tolist()
    boxes, parts = Boxes(pose.rotation, pose.translation, lower, upper), []
    for i, own in enumerate(clouds.slices()):
        some = boxes.take(slice(bounds[i], bounds[i + 1]))
        parts.append(box_query(clouds.points[own], some, config.points, hierarchy.buckets[i]))
    return joined(parts, [own.start for own in clouds.slices()])
