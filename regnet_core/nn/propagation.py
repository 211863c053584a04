"""Feature propagation (PointNet++, section 3.4): features of centroids carried back to the points below.

The first layer is linear and so is interpolation: W [interpolated f, s] = interpolated (W_f f) + W_s s. The first part
is computed at the few centroids instead of the many points.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn
from torch.nn import functional

from regnet_core.nn.int8 import ByteLayers, product_of_features, takes_bytes
from regnet_core.nn.layers import Mlp
from regnet_core.nn.tiles import BYTES_TILE, in_one_go, one_by_one, over_tiles, tiles
from regnet_core.ops.bytes import Gathered, Own, bytes_of_sum
from regnet_core.ops.interpolation import Interpolation, interpolate


class FeaturePropagation(nn.Module):
    """Features of points from those of the centroids near them and their own."""

    def __init__(self, inputs: int, skipped: int, channels: Sequence[int]) -> None:
        super().__init__()
        self.inputs = inputs
        self.mlp = Mlp(inputs + skipped, channels)

    def forward(self, features: torch.Tensor, how: Interpolation, skip: torch.Tensor) -> torch.Tensor:
        """Args:
            features: (C, inputs) of the centroids.
            how: from the centroids to the points.
            skip: (N, skipped), the points' own features.

        Returns:
            (N, C_out).
        """
        if (layers := self.mlp.in_bytes()) is not None:
            return self._in_bytes(layers, features, how, skip)
        weight, bias = self.mlp.linear_part()
        from_centroids, for_skip = functional.linear(features, weight[:, : self.inputs]), weight[:, self.inputs :]

        def tile(rows: slice) -> torch.Tensor:
            carried = interpolate(from_centroids, Interpolation(how.indices[rows], how.weights[rows]))
            return self.mlp.finish(carried + functional.linear(skip[rows], for_skip, bias))

        return tile(slice(None)) if in_one_go(skip) else over_tiles(tile, tiles(len(skip)))

    def _in_bytes(
        self, layers: ByteLayers, features: torch.Tensor, how: Interpolation, skip: torch.Tensor
    ) -> torch.Tensor:
        from_centroids = product_of_features(layers.first(0, self.inputs, False), features)
        wide, own_weight = None, layers.first_weight[:, self.inputs :].t()
        if takes_bytes(skip):
            wide = product_of_features(layers.first(self.inputs, None, False), skip)

        def tile(some: slice) -> torch.Tensor:
            carried = Gathered(from_centroids, how.indices[some], how.weights[some])
            own = Own(skip[some], own_weight) if wide is None else None
            rows = None if wide is None else wide[some]
            return layers.after_first(bytes_of_sum(carried, own, rows, layers.first_bias))[: some.stop - some.start]

        return one_by_one(tile, tiles(len(skip), BYTES_TILE))
