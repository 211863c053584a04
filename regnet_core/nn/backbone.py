"""The PointNet++ backbone: features of every point of the clouds, from set abstractions and feature propagations."""

from __future__ import annotations

import torch
from torch import nn

from regnet_core.nn.clouds import Clouds, point_features
from regnet_core.nn.config import NetworkConfig
from regnet_core.nn.hierarchy import Hierarchy, Level
from regnet_core.nn.propagation import FeaturePropagation
from regnet_core.nn.set_abstraction import SetAbstraction
from regnet_core.ops.interpolation import interpolate


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
        features = self.abstract(clouds, hierarchy)
        return self.propagate(features, clouds, hierarchy)

    def abstract(self, clouds: Clouds, hierarchy: Hierarchy) -> list[torch.Tensor]:
        """Features (C, channels) of the centroids of every level, fine to coarse."""
        points, features = clouds.points, point_features(clouds, self.config)
        found = []
        for abstraction, level in zip(self.abstractions, hierarchy.levels, strict=True):
            features = abstraction(points, features, level)
            points = level.points
            found.append(features)
        return found

    def propagate(self, features: list[torch.Tensor], clouds: Clouds, hierarchy: Hierarchy) -> torch.Tensor:
        """Features (N, C) of all points, given those of every level's centroids."""
        skips = [fine_skip(clouds, hierarchy.levels[0], self.config), *features[:-1]]
        carried = features[-1]
        for propagation, level, skip in zip(
            self.propagations, reversed(hierarchy.levels), reversed(skips), strict=True
        ):
            carried = propagation(carried, level.interpolation, skip)
        return carried


def fine_skip(clouds: Clouds, level: Level, config: NetworkConfig) -> torch.Tensor:
    """What the points bring to the last feature propagation (N, 3 + C): where they are, and their own features.

    The published code takes the absolute position. We take the offset from where the interpolation of the three
    nearest centroids lands, in units of the first radius, which does not depend on the origin.
    """
    offset = (clouds.points - interpolate(level.points, level.interpolation)) / config.abstractions[0].radius
    own = point_features(clouds, config)
    return offset if own is None else torch.cat([offset, own], dim=1)
