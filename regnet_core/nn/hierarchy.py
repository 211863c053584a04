"""What the backbone needs to know of where points are: centroids, neighbourhoods and interpolations of every level.

None of it depends on weights or needs gradients, so that it can be made ahead, in a data loader or while another
cloud is in the network.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch

from regnet_core.nn.clouds import Clouds
from regnet_core.nn.config import AbstractionConfig, NetworkConfig
from regnet_core.ops.ball_query import ball_query, point_grid
from regnet_core.ops.farthest_points import farthest_points
from regnet_core.ops.interpolation import Interpolation, three_nearest
from regnet_core.ops.neighbourhoods import Neighbourhoods, joined
from regnet_core.ops.voxel_grid import VoxelGrid


class Level(NamedTuple):
    """The centroids of one set abstraction, of all clouds."""

    points: torch.Tensor
    """(C, 3): where they are [m]."""
    source: torch.Tensor
    """(C,): their rows among the clouds' points."""
    below: torch.Tensor
    """(C,): their rows in the level below."""
    offsets: torch.Tensor
    """(B + 1,): where each cloud's begin."""
    neighbours: Neighbourhoods
    """Of each centroid, in the level below."""
    interpolation: Interpolation
    """From this level to the one below."""

    def to(self, device: torch.device | str) -> Level:
        """The same on another device."""
        return Level(*(value.to(device) for value in self))  # type: ignore[arg-type]

    def slices(self) -> list[slice]:
        """The rows of each cloud."""
        bounds = self.offsets.tolist()
        return [slice(first, last) for first, last in pairwise(bounds)]


class Hierarchy(NamedTuple):
    """The levels of a batch of clouds, fine to coarse."""

    levels: tuple[Level, ...]
    grids: tuple[VoxelGrid | None, ...]
    """Of each cloud's points, for further queries of them on a CPU."""

    def to(self, device: torch.device | str) -> Hierarchy:
        """The same on another device."""
        grids = self.grids if torch.device(device).type == "cpu" else (None,) * len(self.grids)
        return Hierarchy(tuple(level.to(device) for level in self.levels), grids)


@torch.no_grad()
def build_hierarchy(clouds: Clouds, config: NetworkConfig) -> Hierarchy:
    """The levels that a network of this configuration has for these clouds."""
    rows = clouds.slices()
    grids = tuple(point_grid(clouds.points[own], config.abstractions[0].radius) for own in rows)
    # All levels' centroids come from one sequence, of which each takes the first ones: farthest_points.py says why.
    sequences = [farthest_points(clouds.points[own], config.abstractions[0].centroids) + own.start for own in rows]
    levels: list[Level] = []
    below, below_rows, below_grids = clouds.points, rows, grids
    for abstraction in config.abstractions:
        level = _level(clouds.points, sequences, abstraction, below, below_rows, below_grids, first=not levels)
        levels.append(level)
        below, below_rows, below_grids = level.points, level.slices(), (None,) * len(rows)
    return Hierarchy(tuple(levels), grids)


def _level(
    points: torch.Tensor,
    sequences: list[torch.Tensor],
    config: AbstractionConfig,
    below: torch.Tensor,
    below_rows: list[slice],
    below_grids: tuple[VoxelGrid | None, ...],
    first: bool,
) -> Level:
    chosen = [sequence[: config.centroids] for sequence in sequences]
    source = torch.cat(chosen)
    counts = torch.tensor([0, *(len(c) for c in chosen)], device=points.device)
    offsets = counts.cumsum(0)
    position = points[source]
    starts = [own.start for own in below_rows]
    neighbours, interpolations = [], []
    for i, own in enumerate(below_rows):
        centres = points[chosen[i]]
        neighbours.append(ball_query(below[own], centres, config.radius, config.neighbours, below_grids[i]))
        interpolations.append(three_nearest(centres, below[own]))
    ahead = offsets.tolist()
    return Level(
        points=position,
        source=source,
        below=source if first else _first_rows(chosen, starts),
        offsets=offsets,
        neighbours=joined(neighbours, starts),
        interpolation=Interpolation(
            torch.cat([part.indices + start for part, start in zip(interpolations, ahead, strict=False)]),
            torch.cat([part.weights for part in interpolations]),
        ),
    )


def _first_rows(chosen: list[torch.Tensor], starts: list[int]) -> torch.Tensor:
    """As many rows of each cloud, from its start, as are chosen of it."""
    return torch.cat([torch.arange(s, s + len(c), device=c.device) for c, s in zip(chosen, starts, strict=True)])
