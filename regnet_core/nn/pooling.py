"""A shared MLP at every neighbour of every centre, and the maximum over each centre's (PointNet), on ragged
neighbourhoods.

The first layer is linear: W [own_e, f_j] = W_own own_e + W_f f_j, where own_e is what the neighbour brings of its own
(such as where it is, as seen from the centre) and f_j the features of the point that it is. The part of the features is
computed once for each point, not once for each of the neighbourhoods that it is in. ``own`` has a few columns only and
is multiplied for each neighbour: W_x x_j - W_x x_c would lose in bfloat16 what the small difference of two large
numbers holds.

Without the repeats of the first neighbour that padded implementations have, the maximum is the same. So is everything
else in evaluation; in training, batch normalisation sees each neighbour once, while padding weighs the first
neighbours of sparse neighbourhoods more.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from torch.nn import functional

from regnet_core.nn.int8 import takes_bytes
from regnet_core.nn.layers import DenseLayer, Mlp
from regnet_core.nn.tiles import TILE, in_one_go, over_tiles
from regnet_core.ops.bytes import Gathered, Own, Sum
from regnet_core.ops.neighbourhoods import Neighbourhoods
from regnet_core.ops.segments import rectified_segment_max, segment_max

OwnFeatures = Callable[[slice, Neighbourhoods], torch.Tensor]
"""What E neighbours bring of their own (E, K), given which centres they belong to and these neighbourhoods."""


class PooledMlp(Mlp):
    """(N, C_in - K) features of points and (E, K) of neighbours -> (centres, C_out); 0 where there is no neighbour."""

    pools = True

    def carried(self, own_channels: int, features: torch.Tensor) -> torch.Tensor:
        """What the points' features (N, C_in - K) come to in the first layer (N, C_1), for ``pooled``."""
        if (layers := self.in_bytes()) is not None:
            if takes_bytes(features):
                return layers.carried(features, own_channels, None, with_bias=True)
            return functional.linear(features, layers.first_weight[:, own_channels:], layers.first_bias)
        weight, bias = self.linear_part()
        return functional.linear(features, weight[:, own_channels:], bias)

    def pooled(
        self, own: OwnFeatures, own_channels: int, carried: torch.Tensor | None, neighbours: Neighbourhoods
    ) -> torch.Tensor:
        """Args:
            own: features of the neighbours' own.
            own_channels: K, how many.
            carried: (N, C_1) of the points' features; None where they have none.
            neighbours: of the centres, as rows of the points.

        Returns:
            (centres, C_out).
        """
        if (layers := self.in_bytes()) is not None:
            from_points = None if carried is None else Gathered(carried, neighbours.indices[:, None])
            brought = Own(own(slice(None), neighbours), layers.first_weight[:, :own_channels].t())
            added = layers.first_bias if carried is None else None
            return layers.pooled(Sum(from_points, brought, bias=added), neighbours.offsets)
        weight, bias = self.linear_part()
        for_own = weight[:, :own_channels]

        def tile(some: slice, near: Neighbourhoods) -> torch.Tensor:
            brought = own(some, near)
            if carried is None:
                product = functional.linear(brought, for_own, bias)
            else:
                product = torch.addmm(carried.index_select(0, near.indices), brought, for_own.t())
            return self._maximum(product, near.offsets)

        if in_one_go(neighbours.indices):
            return tile(slice(None), neighbours)
        return over_tiles(lambda part: tile(*part), neighbours.tiles(TILE))

    def _maximum(self, product: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
        """The end of it, given what the first layer's linear part gives."""
        if self.training or torch.is_grad_enabled():
            return segment_max(self.finish(product), offsets)
        # The last rectifier comes after the maximum, which it does not change: there it has far fewer rows.
        layers: list[DenseLayer] = list(self)  # type: ignore[arg-type]
        for layer, following in pairwise(layers):
            product = functional.linear(layer.finish(product), *following.linear_part())
        return rectified_segment_max(product, offsets)
