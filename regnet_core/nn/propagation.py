"""Feature propagation (PointNet++, section 3.4): features of centroids carried back to the points below.

The first layer is linear and so is interpolation: W [interpolated f, s] = interpolated (W_f f) + W_s s. The first part
is computed at the few centroids instead of the many points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional

from regnet_core.nn.int8 import ByteLayers, takes_bytes
from regnet_core.nn.layers import Mlp
from regnet_core.nn.tiles import in_one_go, over_tiles, tiles
from regnet_core.ops.bytes import Gathered, Own, Sum
from regnet_core.ops.interpolation import Interpolation, interpolate


@dataclass
class Kept:
    """What calls for the same centroids have in common."""

    at_centroids: torch.Tensor | None = None
    """(C, C_1): what their features come to in the first layer."""


class FeaturePropagation(nn.Module):
    """Features of points from those of the centroids near them and their own."""

    def __init__(self, inputs: int, skipped: int, channels: Sequence[int]) -> None:
        super().__init__()
        self.inputs = inputs
        self.mlp = Mlp(inputs + skipped, channels)

    def forward(
        self, features: torch.Tensor, how: Interpolation, skip: torch.Tensor, kept: Kept | None = None
    ) -> torch.Tensor:
        """Args:
            features: (C, inputs) of the centroids.
            how: from the centroids to the points.
            skip: (N, skipped), the points' own features.
            kept: what the features come to at the centroids is kept here for further points.

        Returns:
            (N, C_out).
        """
        kept = kept or Kept()
        layers = self.mlp.in_bytes()
        if kept.at_centroids is None:
            kept.at_centroids = self._at_centroids(layers, features)
        from_centroids = kept.at_centroids
        if layers is not None:
            return self._in_bytes(layers, from_centroids, how, skip)
        weight, bias = self.mlp.linear_part()
        for_skip = weight[:, self.inputs :]

        def tile(rows: slice) -> torch.Tensor:
            carried = interpolate(from_centroids, Interpolation(how.indices[rows], how.weights[rows]))
            return self.mlp.finish(carried + functional.linear(skip[rows], for_skip, bias))

        return tile(slice(None)) if in_one_go(skip) else over_tiles(tile, tiles(len(skip)))

    def _at_centroids(self, layers: ByteLayers | None, features: torch.Tensor) -> torch.Tensor:
        if layers is not None:
            return layers.carried(features, 0, self.inputs, with_bias=False)
        return functional.linear(features, self.mlp.linear_part().weight[:, : self.inputs])

    def _in_bytes(
        self, layers: ByteLayers, from_centroids: torch.Tensor, how: Interpolation, skip: torch.Tensor
    ) -> torch.Tensor:
        carried, bias = Gathered(from_centroids, how.indices, how.weights), layers.first_bias
        if takes_bytes(skip):
            return layers.of_sum(Sum(carried, rows=layers.carried(skip, self.inputs, None, with_bias=False), bias=bias))
        return layers.of_sum(Sum(carried, Own(skip, layers.first_weight[:, self.inputs :].t()), bias=bias))
