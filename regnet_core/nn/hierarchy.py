"""What the backbone needs to know of where points are: centroids, neighbourhoods and interpolations of every level.

None of it depends on weights or needs gradients, so that it can be made ahead, in a data loader or while another
cloud is in the network.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch

from regnet_core.nn.clouds import Clouds, buckets_of
from regnet_core.nn.config import AbstractionConfig, NetworkConfig
from regnet_core.ops.ball_query import ball_query
from regnet_core.ops.buckets import Buckets, point_buckets
from regnet_core.ops.farthest_points import farthest_points
from regnet_core.ops.interpolation import Interpolation, three_nearest
from regnet_core.ops.neighbourhoods import Neighbourhoods, joined


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
    interpolation: Interpolation | None
    """From this level to the one below; None for the first level where only some of the points will be asked about."""

    def to(self, device: torch.device | str) -> Level:
        """The same on another device."""
        return Level(*(None if value is None else value.to(device) for value in self))  # type: ignore[arg-type]

    def slices(self) -> list[slice]:
        """The rows of each cloud."""
        bounds = self.offsets.tolist()
        return [slice(first, last) for first, last in pairwise(bounds)]


class Hierarchy(NamedTuple):
    """The levels of a batch of clouds, fine to coarse."""

    levels: tuple[Level, ...]
    buckets: tuple[Buckets | None, ...]
    """Of each cloud's points, for further searches among them on a CPU."""
    centroids: tuple[Buckets | None, ...]
    """Of each cloud's centroids of the first level, likewise."""

    def to(self, device: torch.device | str) -> Hierarchy:
        """The same on another device."""
        levels, nothing = tuple(level.to(device) for level in self.levels), (None,) * len(self.buckets)
        if torch.device(device).type == "cpu":
            return self._replace(levels=levels)
        return Hierarchy(levels, nothing, nothing)


@torch.no_grad()
def build_hierarchy(
    clouds: Clouds,
    config: NetworkConfig,
    buckets: Sequence[Buckets | None] | None = None,
    to_all_points: bool = True,
) -> Hierarchy:
    """The levels that a network of this configuration has for these clouds.

    Args:
        clouds: B clouds.
        config: of the network.
        buckets: of each cloud's points (``buckets_of``), where they were made already.
        to_all_points: whether to find the interpolation from the first level to all points.
    """
    rows = clouds.slices()
    parts = list(buckets or buckets_of(clouds))
    # All levels' centroids come from one sequence, of which each takes the first ones: farthest_points.py says why.
    most = config.abstractions[0].centroids
    sequences = [
        farthest_points(clouds.points[own], most, part) + own.start for own, part in zip(rows, parts, strict=True)
    ]
    levels: list[Level] = []
    own_buckets, of_centroids = tuple(parts), tuple[Buckets | None, ...]()
    below = _Below(clouds.points, rows, parts)
    for abstraction in config.abstractions:
        level, parts = _level(clouds.points, sequences, abstraction, below, not levels, to_all_points or bool(levels))
        of_centroids = of_centroids or tuple(parts)
        levels.append(level)
        below = _Below(level.points, level.slices(), parts)
    return Hierarchy(tuple(levels), own_buckets, of_centroids)


class _Below(NamedTuple):
    """What a level's centroids look at."""

    points: torch.Tensor
    """(N, 3) of all clouds [m]."""
    rows: list[slice]
    """Of each cloud."""
    buckets: list[Buckets | None]
    """Of each cloud's, on a CPU."""


def _level(
    points: torch.Tensor,
    sequences: list[torch.Tensor],
    config: AbstractionConfig,
    below: _Below,
    first: bool,
    interpolates: bool,
) -> tuple[Level, list[Buckets | None]]:
    """The level, and each cloud's centroids in buckets."""
    chosen = [sequence[: config.centroids] for sequence in sequences]
    source = torch.cat(chosen)
    counts = torch.tensor([0, *(len(c) for c in chosen)], device=points.device)
    offsets = counts.cumsum(0)
    position = points[source]
    starts = [own.start for own in below.rows]
    neighbours, interpolations, buckets = [], [], []
    for i, own in enumerate(below.rows):
        centres, given = points[chosen[i]], below.points[own]
        parts = point_buckets(centres)
        neighbours.append(ball_query(given, centres, config.radius, config.neighbours, below.buckets[i]))
        if interpolates:
            interpolations.append(three_nearest(centres, given, parts, below.buckets[i]))
        buckets.append(parts)
    level = Level(
        points=position,
        source=source,
        below=source if first else _first_rows(chosen, starts),
        offsets=offsets,
        neighbours=joined(neighbours, starts),
        interpolation=_joined(interpolations, offsets.tolist()) if interpolates else None,
    )
    return level, buckets


def interpolation_to_points(clouds: Clouds, hierarchy: Hierarchy, rows: torch.Tensor) -> Interpolation:
    """From the centroids of the first level to some points: rows (n,) of the clouds' points, ascending."""
    level = hierarchy.levels[0]
    if level.interpolation is not None:
        return Interpolation(level.interpolation.indices[rows], level.interpolation.weights[rows])
    bounds = torch.searchsorted(rows, clouds.offsets).tolist()
    parts = [
        three_nearest(level.points[own], clouds.points[rows[first:last]], part)
        for own, (first, last), part in zip(level.slices(), pairwise(bounds), hierarchy.centroids, strict=True)
    ]
    return _joined(parts, level.offsets.tolist())


def _joined(parts: list[Interpolation], starts: list[int]) -> Interpolation:
    """The interpolations of several clouds as one, given where each cloud's centroids begin."""
    indices = [part.indices + start if start else part.indices for part, start in zip(parts, starts, strict=False)]
    if len(parts) == 1:
        return Interpolation(indices[0], parts[0].weights)
    return Interpolation(torch.cat(indices), torch.cat([part.weights for part in parts]))


def _first_rows(chosen: list[torch.Tensor], starts: list[int]) -> torch.Tensor:
    """As many rows of each cloud, from its start, as are chosen of it."""
    return torch.cat([torch.arange(s, s + len(c), device=c.device) for c, s in zip(chosen, starts, strict=True)])
