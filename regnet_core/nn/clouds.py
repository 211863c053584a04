"""A batch of clouds of different sizes as the network takes them: their points, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch

from regnet_core.errors import CloudError
from regnet_core.nn.config import NetworkConfig
from regnet_core.ops.buckets import Buckets, point_buckets
from regnet_core.ops.local_shape import local_shapes, unique_entries

_USUAL_WIDTH, _WIDTH_SPREAD = 0.09, 0.03
"""Middle and half the range of the paper's widths [m]: as a feature, 0.06 m is -1 and 0.12 m is 1."""


class Clouds(NamedTuple):
    """B clouds; cloud b has the points ``offsets[b]`` to ``offsets[b + 1]``."""

    points: torch.Tensor
    """(N, 3) float32 [m], z up."""
    offsets: torch.Tensor
    """(B + 1,) int64, from 0 to N."""
    width: torch.Tensor
    """(B,) float32, the gripper's W for each cloud [m]."""
    colors: torch.Tensor | None = None
    """(N, 3) float32 in [0, 1]."""
    shapes: torch.Tensor | None = None
    """(N, 3, 3) float32, the local shapes (ops/local_shape.py), where they were computed."""

    @classmethod
    def of(
        cls, points: Sequence[torch.Tensor], width: Sequence[float], colors: Sequence[torch.Tensor] | None = None
    ) -> Clouds:
        """Join clouds (n, 3), each with its gripper's width [m] and, where there are any, colours (n, 3).

        Raises:
            CloudError: there is no cloud, or the numbers of clouds, widths, points and colours differ.
        """
        if len(points) == 0 or len(points) != len(width) or (colors is not None and len(colors) != len(points)):
            raise CloudError(f"each of the clouds needs one width (and colours or none), got {len(points)} clouds")
        for i, cloud in enumerate(points):
            if cloud.ndim != 2 or cloud.shape[1] != 3 or (colors is not None and colors[i].shape != cloud.shape):
                raise CloudError(
                    f"points and colours must have one shape (n, 3), got {tuple(cloud.shape)} for cloud {i}"
                )
        counts = torch.tensor([0, *(len(cloud) for cloud in points)])
        device = points[0].device
        return cls(
            torch.cat([cloud.float() for cloud in points]),
            counts.cumsum(0).to(device),
            torch.tensor(list(width), dtype=torch.float32, device=device),
            None if colors is None else torch.cat([colour.float() for colour in colors]),
        )

    @classmethod
    def stacked(cls, points: torch.Tensor, width: torch.Tensor, colors: torch.Tensor | None = None) -> Clouds:
        """Clouds of equal size: points (B, n, 3), width (B,), colours (B, n, 3) or None."""
        batch, n = points.shape[:2]
        return cls(
            points.reshape(-1, 3).float(),
            torch.arange(batch + 1, device=points.device) * n,
            width.float(),
            None if colors is None else colors.reshape(-1, 3).float(),
        )

    def to(self, device: torch.device | str) -> Clouds:
        """The same on another device."""
        return Clouds(*(None if value is None else value.to(device) for value in self))  # type: ignore[arg-type]

    def slices(self) -> list[slice]:
        """The rows of each cloud."""
        bounds = self.offsets.tolist()
        return [slice(first, last) for first, last in pairwise(bounds)]

    def numbers(self) -> torch.Tensor:
        """(N,): the cloud that each point belongs to."""
        if len(self.width) == 1:
            return torch.zeros(len(self.points), dtype=torch.int64, device=self.points.device)
        index = torch.arange(len(self.width), device=self.points.device)
        return torch.repeat_interleave(index, self.offsets.diff(), output_size=len(self.points))


def point_features(clouds: Clouds, config: NetworkConfig) -> torch.Tensor | None:
    """What every point comes with: the scaled width, then the colours in [-1, 1], then the local shape -> (N, C).

    None where it is nothing.

    Raises:
        CloudError: the network wants colours and there are none.
    """
    parts = []
    if config.width:
        width = width_feature(clouds.width)[:, None]
        parts.append(width.expand(len(clouds.points), 1) if len(width) == 1 else width[clouds.numbers()])
    if config.colour:
        if clouds.colors is None:
            raise CloudError(f"the network '{config.name}' needs the points' colours, and the clouds have none")
        parts.append(clouds.colors * 2.0 - 1.0)
    if clouds.shapes is not None:
        parts.append(unique_entries(clouds.shapes))
    return torch.cat(parts, dim=1) if parts else None


@torch.no_grad()
def with_shapes(clouds: Clouds, config: NetworkConfig, buckets: Sequence[Buckets | None] | None = None) -> Clouds:
    """The clouds with their local shapes, where the network wants them; without, where it does not.

    Args:
        clouds: B clouds.
        config: of the network.
        buckets: of each cloud's points (``buckets_of``), where they were made already.
    """
    if config.shape_radius == 0.0:
        return clouds._replace(shapes=None)
    if clouds.shapes is not None:
        return clouds
    parts = buckets or [None] * len(clouds.width)
    shapes = [
        local_shapes(clouds.points[own], config.shape_radius, part)
        for own, part in zip(clouds.slices(), parts, strict=True)
    ]
    return clouds._replace(shapes=torch.cat(shapes))


def buckets_of(clouds: Clouds) -> list[Buckets | None]:
    """Each cloud's points in buckets, on a CPU."""
    return [point_buckets(clouds.points[own]) for own in clouds.slices()]


def width_feature(width: torch.Tensor) -> torch.Tensor:
    """Widths [m] as a feature of points: about -1 to 1."""
    return (width - _USUAL_WIDTH) / _WIDTH_SPREAD
