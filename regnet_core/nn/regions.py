"""From point confidence to grasp regions: the top k1 positive points, and the features of what surrounds them."""

from __future__ import annotations

import torch

from regnet_core.nn.clouds import Clouds
from regnet_core.nn.config import RegionConfig
from regnet_core.nn.hierarchy import Hierarchy
from regnet_core.nn.point_features import PointFeatures
from regnet_core.nn.results import Regions
from regnet_core.ops.ball_query import ball_query
from regnet_core.ops.neighbourhoods import Neighbourhoods, joined
from regnet_core.ops.segments import neighbour_max


def candidate_points(
    clouds: Clouds, hierarchy: Hierarchy, layer: int, eligible: torch.Tensor | None = None
) -> list[torch.Tensor]:
    """Rows of the points of each cloud that may become positive.

    Args:
        clouds: the points.
        hierarchy: of the clouds.
        layer: 1 takes all points, 2 the centroids of the first level, and so on.
        eligible: (N,) which of these; all of them when None.
    """
    found = []
    for i, own in enumerate(clouds.slices()):
        if layer == 1:
            rows = torch.arange(own.start, own.stop, device=clouds.points.device)
        else:
            level = hierarchy.levels[layer - 2]
            rows = level.source[level.slices()[i]]
        found.append(rows if eligible is None else rows[eligible[rows]])
    return found


def select_regions(
    confidence: torch.Tensor, candidates: list[torch.Tensor], clouds: Clouds, positives: int, least: float = 0.0
) -> Regions:
    """The most confident points of each cloud.

    Args:
        confidence: (N,) logits of all points.
        candidates: rows of each cloud's points to choose from.
        clouds: the points.
        positives: k1, how many of each cloud at most.
        least: points below this confidence are not chosen.
    """
    confidence = confidence.detach()
    chosen = []
    for rows in candidates:
        sure = rows[torch.sigmoid(confidence[rows]) >= least]
        chosen.append(sure[confidence[sure].sort(descending=True, stable=True).indices[:positives]])
    return regions_at(torch.cat(chosen), clouds)


def regions_at(source: torch.Tensor, clouds: Clouds) -> Regions:
    """Regions around given points, for training: rows (R,) of the clouds' points, in the order of the clouds."""
    bounds = torch.searchsorted(
        source_clouds := clouds.numbers()[source], torch.arange(len(clouds.width) + 1, device=source.device)
    )
    return Regions(source, clouds.points[source], source_clouds, bounds)


@torch.no_grad()
def region_neighbours(regions: Regions, clouds: Clouds, hierarchy: Hierarchy, config: RegionConfig) -> Neighbourhoods:
    """The points of each region, as rows of the clouds' points."""
    bounds, parts = regions.offsets.tolist(), []
    for i, own in enumerate(clouds.slices()):
        centres = regions.points[bounds[i] : bounds[i + 1]]
        parts.append(ball_query(clouds.points[own], centres, config.radius, config.points, hierarchy.buckets[i]))
    return joined(parts, [own.start for own in clouds.slices()])


def pool_regions(
    points: PointFeatures, regions: Regions, clouds: Clouds, hierarchy: Hierarchy, config: RegionConfig | None
) -> torch.Tensor:
    """Features (R, C) of regions: the maximum over their points'; without regions, those of their positive points."""
    if config is None:
        points.need(regions.source)
        return points.values.index_select(0, regions.source)
    near = region_neighbours(regions, clouds, hierarchy, config)
    points.need(near.indices)
    return neighbour_max(points.values, near)
