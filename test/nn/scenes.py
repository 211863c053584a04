"""Clouds to try the network on."""

from __future__ import annotations

import torch

from regnet_core.nn.clouds import Clouds


def tabletop(points: int, seed: int = 0, side: float = 0.5) -> torch.Tensor:
    """(points, 3): a table of this side length with boxes on it, far from the origin [m]."""
    generator = torch.Generator().manual_seed(seed)
    xy = (torch.rand(points, 2, generator=generator) - 0.5) * side
    z = torch.zeros(points)
    for _ in range(8):
        centre = (torch.rand(2, generator=generator) - 0.5) * side * 0.7
        half, height = torch.rand(2, generator=generator) * 0.04 + 0.02, torch.rand(1, generator=generator) * 0.1
        z = torch.where(((xy - centre).abs() < half).all(dim=1), torch.maximum(z, height), z)
    cloud = torch.cat([xy, z[:, None]], dim=1) + 0.001 * torch.randn(points, 3, generator=generator)
    return cloud + torch.tensor([0.6, -0.1, 0.75])


def batch(*sizes: int, width: float = 0.08, side: float = 0.5) -> Clouds:
    """Clouds of these sizes, with colours."""
    generator = torch.Generator().manual_seed(99)
    clouds = [tabletop(size, seed, side) for seed, size in enumerate(sizes)]
    widths = [width + 0.01 * i for i in range(len(sizes))]
    return Clouds.of(clouds, widths, [torch.rand(size, 3, generator=generator) for size in sizes])
