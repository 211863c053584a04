"""From point confidence to grasp regions: the top k1 positive points, and the features of what surrounds them."""

from __future__ import annotations

import torch

from regnet_core.nn.clouds import Clouds
from regnet_core.nn.config import RegionConfig
from regnet_core.nn.hierarchy import Hierarchy
from regnet_core.nn.results import Regions
from regnet_core.ops.ball_query import ball_query
from regnet_core.ops.neighbourhoods import Neighbourhoods, joined
from regnet_core.ops.segments import neighbour_max


def select_regions(
    confidence: torch.Tensor,
    clouds: Clouds,
    hierarchy: Hierarchy,
    layer: int,
    positives: int,
    eligible: torch.Tensor | None = None,
) -> Regions:
    """The most confident points of each cloud.

    Args:
        confidence: (N,) of all points.
        clouds: the points.
        hierarchy: of the clouds.
        layer: 1 chooses among all points, 2 among the centroids of the first level, and so on.
        positives: k1, how many of each cloud at most.
        eligible: (N,) which points may be chosen; all of them when None.
    """
    confidence = confidence.detach()
    chosen = []
    for i, own in enumerate(clouds.slices()):
        if layer == 1:
            rows = torch.arange(own.start, own.stop, device=confidence.device)
        else:
            level = hierarchy.levels[layer - 2]
            rows = level.source[level.slices()[i]]
        if eligible is not None:
            rows = rows[eligible[rows]]
        best = confidence[rows].sort(descending=True, stable=True).indices[:positives]
        chosen.append(rows[best])
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
        parts.append(ball_query(clouds.points[own], centres, config.radius, config.points, hierarchy.grids[i]))
    return joined(parts, [own.start for own in clouds.slices()])


def pool_regions(
    features: torch.Tensor, regions: Regions, clouds: Clouds, hierarchy: Hierarchy, config: RegionConfig | None
) -> torch.Tensor:
    """Features (R, C) of regions: the maximum over their points' (N, C); without regions, those of their points."""
    if config is None:
        return features.index_select(0, regions.source)
    return neighbour_max(features, region_neighbours(regions, clouds, hierarchy, config))
