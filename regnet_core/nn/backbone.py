"""The PointNet++ backbone: features of every point of the clouds, from set abstractions and feature propagations."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import nn

from regnet_core.nn.clouds import Clouds, point_features
from regnet_core.nn.config import NetworkConfig
from regnet_core.nn.hierarchy import Hierarchy, Level, interpolation_to_points
from regnet_core.nn.propagation import FeaturePropagation, Kept
from regnet_core.nn.set_abstraction import SetAbstraction
from regnet_core.ops.interpolation import Interpolation, interpolate


class Backbone(nn.Module):
    """PointNet++ with the gripper's width as a feature of every point; nothing depends on where the origin is."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.abstractions = nn.ModuleList()
        skips, channels = [3 + config.point_channels], config.point_channels
        for abstraction in config.abstractions:
            self.abstractions.append(SetAbstraction(channels, abstraction))
            channels = abstraction.channels[-1]
            skips.append(channels)
        self.propagations = nn.ModuleList()
        for skipped, sizes in zip(reversed(skips[:-1]), config.propagations, strict=True):
            self.propagations.append(FeaturePropagation(channels, skipped, sizes))
            channels = sizes[-1]

    def forward(self, clouds: Clouds, hierarchy: Hierarchy) -> torch.Tensor:
        """Features (N, C) of all points of the clouds."""
        return self.fine(self.coarse(clouds, hierarchy), None)

    def coarse(self, clouds: Clouds, hierarchy: Hierarchy) -> Coarse:
        """All that comes before the last feature propagation."""
        own = point_features(clouds, self.config)
        found = self.abstract(clouds, hierarchy, own)
        carried = found[-1]
        for number in range(len(found) - 1, 0, -1):
            interpolation = hierarchy.levels[number].interpolation
            assert interpolation is not None  # only the first level may be without
            propagation = self.propagations[len(found) - 1 - number]
            carried = propagation(carried, interpolation, found[number - 1])
        return Coarse(clouds, hierarchy, own, carried, Kept())

    def abstract(self, clouds: Clouds, hierarchy: Hierarchy, own: torch.Tensor | None) -> list[torch.Tensor]:
        """Features (C, channels) of the centroids of every level, fine to coarse, given the points' own."""
        points, features, found = clouds.points, own, []
        for abstraction, level in zip(self.abstractions, hierarchy.levels, strict=True):
            features = abstraction(points, features, level)
            points = level.points
            found.append(features)
        return found

    def fine(self, coarse: Coarse, rows: torch.Tensor | None) -> torch.Tensor:
        """Features (n, C) of some points, rows (n,) of the clouds' points in ascending order, or of all."""
        clouds, level, own = coarse.clouds, coarse.hierarchy.levels[0], coarse.own
        points = clouds.points
        if rows is None:
            how = level.interpolation
            if how is None:
                how = interpolation_to_points(clouds, coarse.hierarchy, torch.arange(len(points), device=points.device))
        else:
            how, points = interpolation_to_points(clouds, coarse.hierarchy, rows), points[rows]
            own = None if own is None else own[rows]
        skip = fine_skip(points, own, level, how, self.config)
        return self.propagations[-1](coarse.features, how, skip, coarse.kept)  # type: ignore[no-any-return]


class Coarse(NamedTuple):
    """What the features of the clouds' points follow from."""

    clouds: Clouds
    hierarchy: Hierarchy
    own: torch.Tensor | None
    """(N, K): what the points come with."""
    features: torch.Tensor
    """(C, channels) of the first level's centroids."""
    kept: Kept
    """Of the last feature propagation."""


def fine_skip(
    points: torch.Tensor, own: torch.Tensor | None, level: Level, how: Interpolation, config: NetworkConfig
) -> torch.Tensor:
    """What points (n, 3) bring to the last feature propagation (n, 3 + K): where they are, and their own (n, K).

    The published code takes the absolute position. We take the offset from where the interpolation of the three
    nearest centroids lands, in units of the first radius, which does not depend on the origin.
    """
    offset = (points - interpolate(level.points, how)) / config.abstractions[0].radius
    return offset if own is None else torch.cat([offset, own], dim=1)
