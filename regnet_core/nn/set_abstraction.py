"""Set abstraction (PointNet++, section 3.2) on ragged neighbourhoods.

The first layer is linear: W [(x_j - x_c) / r, f_j] = W_x (x_j - x_c) / r + W_f f_j. The part of the features is
computed once for each point, not once for each of the neighbourhoods that it is in. The part of the position has three
columns only and is computed for each neighbour: W_x x_j - W_x x_c would lose in bfloat16 what the small difference of
two large numbers holds.

Without the repeats of the first neighbour that padded implementations have, the maximum is the same. So is everything
else in evaluation; in training, batch normalisation sees each neighbour once, while padding weighs the first
neighbours of sparse neighbourhoods more.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

from regnet_core.nn.config import AbstractionConfig
from regnet_core.nn.hierarchy import Level
from regnet_core.nn.layers import TILE, Mlp, in_one_go
from regnet_core.ops.neighbourhoods import Neighbourhoods
from regnet_core.ops.segments import segment_max


class SetAbstraction(nn.Module):
    """Features of centroids from those of their neighbours."""

    def __init__(self, inputs: int, config: AbstractionConfig) -> None:
        super().__init__()
        self.radius = config.radius
        self.mlp = Mlp(3 + inputs, config.channels)

    def forward(self, points: torch.Tensor, features: torch.Tensor | None, level: Level) -> torch.Tensor:
        """Args:
            points: (N, 3) of the level below [m].
            features: (N, C_in) of these points; None where they have none.
            level: the centroids.

        Returns:
            (C, C_out).
        """
        weight, bias = self.mlp.linear_part()
        once = None if features is None else functional.linear(features, weight[:, 3:], bias)

        def pooled(some: slice, neighbours: Neighbourhoods) -> torch.Tensor:
            centres = level.points[some].index_select(0, neighbours.centres())
            offset = (points.index_select(0, neighbours.indices) - centres) / self.radius
            if once is None:
                product = functional.linear(offset, weight, bias)
            else:
                product = torch.addmm(once.index_select(0, neighbours.indices), offset, weight[:, :3].t())
            return segment_max(self.mlp.finish(product), neighbours.offsets)

        if in_one_go(len(level.neighbours.indices)):
            return pooled(slice(None), level.neighbours)
        return torch.cat([pooled(*tile) for tile in level.neighbours.tiles(TILE)])
