"""What the stages of the network give."""

from __future__ import annotations

from typing import NamedTuple

import torch

from regnet_core.nn.anchors import Pose
from regnet_core.nn.hierarchy import Hierarchy
from regnet_core.nn.point_features import PointFeatures


class StagePrediction(NamedTuple):
    """What the second stage says of the M anchors of R regions (R, M), or the third of G proposals (G,); float32."""

    logit: torch.Tensor
    """(...,): of being a grasp."""
    residual: torch.Tensor
    """(..., 8): as the coders of anchors.py take them."""
    quality: torch.Tensor
    """(...,): logit of s_q."""


class Regions(NamedTuple):
    """The grasp regions of B clouds, most confident first within each cloud."""

    source: torch.Tensor
    """(R,) int64: rows of their positive points among the clouds' points."""
    points: torch.Tensor
    """(R, 3): where these are [m]."""
    cloud: torch.Tensor
    """(R,) int64: the cloud that each belongs to."""
    offsets: torch.Tensor
    """(B + 1,) int64: where each cloud's begin."""


class Proposed(NamedTuple):
    """The first two stages' results."""

    hierarchy: Hierarchy
    points: PointFeatures
    """Of the points that were asked about."""
    confidence: torch.Tensor
    """(N,) float32: logit of the point grasp confidence, eq. (1); -infinity where it was not computed, because the
    point cannot become positive."""
    regions: Regions
    region_features: torch.Tensor
    """(R, C)."""
    anchors: StagePrediction
    """(R, M)."""

    @property
    def features(self) -> torch.Tensor:
        """(N, C): of the points, from the backbone; anything for those that nobody asked about."""
        return self.points.values


class Candidates(NamedTuple):
    """G proposals on their way to the Refine Network."""

    pose: Pose
    """(G, 3, 3) and (G, 3) [m]."""
    region: torch.Tensor
    """(G,) int64: the region that each comes from, ascending."""
    anchor: torch.Tensor
    """(G,) int64: the region's anchor that each comes from."""

    def take(self, rows: torch.Tensor) -> Candidates:
        """Some of them."""
        pose = Pose(self.pose.rotation[rows], self.pose.translation[rows])
        return Candidates(pose, self.region[rows], self.anchor[rows])


class Refined(NamedTuple):
    """The third stage's results for G proposals."""

    prediction: StagePrediction
    """(G,); residuals as ``RefineCoder`` takes them."""
    occupied: torch.Tensor
    """(G,) bool: whether there is any point in the closing area. Where there is none the prediction means nothing."""


class Output(NamedTuple):
    """What a whole forward pass gives."""

    proposed: Proposed
    candidates: Candidates
    """What went into the last pass of the refinement."""
    refined: Refined | None
    """None where the network has no third stage."""


def expected_quality(prediction: StagePrediction) -> torch.Tensor:
    """(...,) in [0, 1]: the probability of being a grasp times the quality that is expected of it."""
    return torch.sigmoid(prediction.logit) * torch.sigmoid(prediction.quality)


def best_of_regions(candidates: Candidates, refined: Refined) -> torch.Tensor:
    """The row (R,) of the best refined proposal of each region that has any, in the order of the regions."""
    region = candidates.region
    best_first = refined_quality(refined).argsort(descending=True, stable=True)
    rows = best_first[region[best_first].argsort(stable=True)]
    first = torch.ones_like(rows, dtype=torch.bool)
    first[1:] = region[rows[1:]] != region[rows[:-1]]
    return rows[first]


def refined_quality(refined: Refined) -> torch.Tensor:
    """(G,) logit of s_q; without points in the closing area, the least there is."""
    return torch.where(refined.occupied, refined.prediction.quality, -torch.inf)


def best_of_clouds(candidates: Candidates, quality: torch.Tensor, regions: Regions, most: int) -> Candidates:
    """At most so many proposals of each cloud, those of the highest quality (G,), in the order they had."""
    cloud, kept = regions.cloud[candidates.region], torch.zeros_like(quality, dtype=torch.bool)
    for one in range(len(regions.offsets) - 1):
        own = (cloud == one).nonzero().squeeze(1)
        kept[own[quality[own].argsort(descending=True, stable=True)[:most]]] = True
    return candidates.take(kept.nonzero().squeeze(1))
