"""Three-nearest-neighbour interpolation (PointNet++, section 3.4): features of few points carried to many."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch.nn import functional

from regnet_core.errors import InvalidInputError
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels
from regnet_core.ops.parallel import for_each_range
from regnet_core.ops.voxel_grid import build_grid, cell_range

_CLOSEST = 1e-10
"""Squared distances below this count as this much [m2]: a point of its own gets all the weight."""
_CHUNK = 1 << 24
"""Pairs of points that the search in torch looks at in one go."""


class Interpolation(NamedTuple):
    """How the values at Q points follow from those at N points."""

    indices: torch.Tensor
    """(Q, 3) int64: the three nearest points, nearest first."""
    weights: torch.Tensor
    """(Q, 3) float32: inverse squared distances, scaled to a sum of 1."""

    def to(self, device: torch.device | str) -> Interpolation:
        """The same on another device."""
        return Interpolation(self.indices.to(device), self.weights.to(device))


def three_nearest(points: torch.Tensor, queries: torch.Tensor) -> Interpolation:
    """The interpolation from points (N, 3) to queries (Q, 3) of one cloud; with N < 3 some weights are 0.

    Raises:
        InvalidInputError: there are queries but no points.
    """
    if len(points) == 0 and len(queries) > 0:
        raise InvalidInputError("interpolation needs at least one point to take values from")
    indices, squared = _search_on(points)(points.detach(), queries.detach())
    weights = 1.0 / squared.clamp(min=_CLOSEST)
    return Interpolation(indices, (weights / weights.sum(dim=1, keepdim=True)).float())


def _search_on(points: torch.Tensor) -> Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
    """What searches on the device of the points."""
    if points.device.type == "cpu":
        return three_nearest_on_cpu
    if has_kernels(points):
        from regnet_core.ops.gpu.nearest import three_nearest_on_gpu

        return three_nearest_on_gpu
    return three_nearest_in_torch


def interpolate(features: torch.Tensor, how: Interpolation) -> torch.Tensor:
    """The features (N, C) of the points carried to the queries -> (Q, C); differentiable."""
    weights = how.weights.to(features.dtype)
    return functional.embedding_bag(how.indices, features, mode="sum", per_sample_weights=weights)


def three_nearest_on_cpu(points: torch.Tensor, queries: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Indices (Q, 3) and squared distances (Q, 3) [m2], nearest first; distances are infinite where N < 3."""
    p, q = points.numpy().astype(np.float64), queries.numpy().astype(np.float64)
    indices, squared = np.zeros((len(q), 3), np.int64), np.full((len(q), 3), np.inf)
    if len(q):
        reach = _usual_reach(p, q)
        grid = build_grid(p, reach)

        def run(start: int, stop: int) -> None:
            _search(
                q, reach, grid.points, grid.order, grid.start, grid.origin, grid.shape, grid.cell,
                start, stop, indices, squared,
            )  # fmt: skip

        for_each_range(run, len(q), least=512)
    return torch.from_numpy(indices), torch.from_numpy(squared)


def three_nearest_in_torch(points: torch.Tensor, queries: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The same on any device: every query is compared with every point."""
    k = min(3, len(points))
    indices = torch.zeros((len(queries), 3), dtype=torch.int64, device=points.device)
    squared = torch.full((len(queries), 3), torch.inf, dtype=torch.float64, device=points.device)
    step = max(1, _CHUNK // max(1, len(points)))
    for q in range(0, len(queries), step):
        some = queries[q : q + step].double()
        distance = sum((some[:, axis, None] - points[None, :, axis].double()).square() for axis in range(3))
        assert isinstance(distance, torch.Tensor)
        nearest = distance.topk(k, dim=1, largest=False)
        indices[q : q + step, :k], squared[q : q + step, :k] = nearest.indices, nearest.values
    return indices, squared


def _usual_reach(points: np.ndarray, queries: np.ndarray) -> float:
    """A radius within which most queries have three points, from a few of the queries [m]."""
    some = queries[:: max(1, len(queries) // 12)][:12]
    squared = ((some[:, None] - points[None]) ** 2).sum(axis=-1)
    k = min(2, len(points) - 1)
    third = np.sqrt(np.partition(squared, k, axis=1)[:, k])
    return float(max(1.3 * np.quantile(third, 0.8), 1e-4))


@compiled
def _search(queries, reach, points, order, starts, origin, shape, cell, begin, end, indices, squared):  # type: ignore[no-untyped-def]
    most = min(3, len(points))
    span = 0.0
    for a in range(3):
        span = max(span, shape[a] * cell)
    for q in range(begin, end):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        away = 0.0
        for a in range(3):
            away = max(away, max(origin[a] - queries[q, a], queries[q, a] - origin[a] - shape[a] * cell))
        radius = reach + max(away, 0.0)
        while True:
            a0 = a1 = a2 = np.inf
            n0 = n1 = n2 = len(order)
            i0, i1 = cell_range(x - radius, x + radius, origin[0], cell, shape[0])
            j0, j1 = cell_range(y - radius, y + radius, origin[1], cell, shape[1])
            k0, k1 = cell_range(z - radius, z + radius, origin[2], cell, shape[2])
            if k1 >= k0:
                for i in range(i0, i1 + 1):
                    for j in range(j0, j1 + 1):
                        row = (i * shape[1] + j) * shape[2]
                        for p in range(starts[row + k0], starts[row + k1 + 1]):
                            dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                            d, n = dx * dx + dy * dy + dz * dz, order[p]
                            # Of equally near points the first one in the cloud counts as nearer.
                            if d < a2 or (d == a2 and n < n2):
                                a2, n2 = d, n
                                if a2 < a1 or (a2 == a1 and n2 < n1):
                                    a1, a2, n1, n2 = a2, a1, n2, n1
                                    if a1 < a0 or (a1 == a0 and n1 < n0):
                                        a0, a1, n0, n1 = a1, a0, n1, n0
            last = a2 if most == 3 else (a1 if most == 2 else a0)
            if last <= radius * radius or radius > 4.0 * (span + max(away, 0.0)):
                break
            radius *= 2.0
        squared[q, 0], indices[q, 0] = a0, n0
        if most > 1:
            squared[q, 1], indices[q, 1] = a1, n1
        if most > 2:
            squared[q, 2], indices[q, 2] = a2, n2
