"""Set abstraction (PointNet++, section 3.2): features of centroids from those of the points around them."""

from __future__ import annotations

import torch
from torch import nn

from regnet_core.nn.config import AbstractionConfig
from regnet_core.nn.hierarchy import Level
from regnet_core.nn.pooling import PooledMlp
from regnet_core.ops.neighbourhoods import Neighbourhoods, offsets_from_centres


class SetAbstraction(nn.Module):
    """Features of centroids from those of their neighbours and from where these are, as seen from the centroid."""

    def __init__(self, inputs: int, config: AbstractionConfig) -> None:
        super().__init__()
        self.radius = config.radius
        self.mlp = PooledMlp(3 + inputs, config.channels)

    def forward(self, points: torch.Tensor, features: torch.Tensor | None, level: Level) -> torch.Tensor:
        """Args:
            points: (N, 3) of the level below [m].
            features: (N, C_in) of these points; None where they have none.
            level: the centroids.

        Returns:
            (C, C_out).
        """

        def offsets(some: slice, near: Neighbourhoods) -> torch.Tensor:
            return offsets_from_centres(points, level.points[some], near, self.radius)

        carried = None if features is None else self.mlp.carried(3, features)
        return self.mlp.pooled(offsets, 3, carried, level.neighbours)
