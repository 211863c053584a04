"""Three-nearest-neighbour interpolation (PointNet++, section 3.4): features of few points carried to many."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch.nn import functional

from regnet_core.errors import InvalidInputError
from regnet_core.ops.buckets import GROUP, SIZE, Buckets, near_bucket, point_buckets
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels
from regnet_core.ops.parallel import for_each_range

_CLOSEST = 1e-10
"""Squared distances below this count as this much [m2]: a point of its own gets all the weight."""
_FEW = 96
"""So many are sorted fastest by insertion."""
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


def three_nearest(
    points: torch.Tensor,
    queries: torch.Tensor,
    point_parts: Buckets | None = None,
    query_parts: Buckets | None = None,
) -> Interpolation:
    """The interpolation from points (N, 3) to queries (Q, 3) of one cloud; with N < 3 some weights are 0.

    Args:
        points: (N, 3) [m].
        queries: (Q, 3) [m].
        point_parts: the points in buckets (``point_buckets``), where they are already.
        query_parts: the queries in buckets.

    Raises:
        InvalidInputError: there are queries but no points.
    """
    if len(points) == 0 and len(queries) > 0:
        raise InvalidInputError("interpolation needs at least one point to take values from")
    points, queries = points.detach(), queries.detach()
    if points.device.type == "cpu":
        indices, squared = three_nearest_on_cpu(points, queries, point_parts, query_parts)
    elif has_kernels(points):
        from regnet_core.ops.gpu.nearest import three_nearest_on_gpu

        indices, squared = three_nearest_on_gpu(points, queries)
    else:
        indices, squared = three_nearest_in_torch(points, queries)
    return Interpolation(indices, _weights(squared))


def _weights(squared: torch.Tensor) -> torch.Tensor:
    """(Q, 3) float32 of squared distances (Q, 3) [m2]."""
    if squared.device.type == "cpu" and squared.dtype == torch.float32:
        weights = torch.empty_like(squared)
        for_each_range(_weigh, len(squared), 5, squared.numpy(), weights.numpy())
        return weights
    weights = 1.0 / squared.clamp(min=_CLOSEST)
    return (weights / weights.sum(dim=1, keepdim=True)).float()


def interpolate(features: torch.Tensor, how: Interpolation) -> torch.Tensor:
    """The features (N, C) of the points carried to the queries -> (Q, C); differentiable."""
    weights = how.weights.to(features.dtype)
    return functional.embedding_bag(how.indices, features, mode="sum", per_sample_weights=weights)


def three_nearest_on_cpu(
    points: torch.Tensor,
    queries: torch.Tensor,
    point_parts: Buckets | None = None,
    query_parts: Buckets | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Indices (Q, 3) and squared distances (Q, 3) [m2], nearest first; distances are infinite where N < 3.

    Of equally near points the first one counts as nearer.
    """
    indices, squared = np.zeros((len(queries), 3), np.int64), np.full((len(queries), 3), np.inf, np.float32)
    if len(queries):
        given, asked = point_parts or point_buckets(points), query_parts or point_buckets(queries)
        assert given is not None and asked is not None  # all are on a CPU
        reach = _usual_reach(given)
        for_each_range(_search, len(asked.rows), 5400, asked, given, reach, indices, squared)
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


def _usual_reach(points: Buckets) -> float:
    """A radius within which most places among the points have three of them [m], from the buckets' sizes: on a surface,
    those of points that are evenly spread."""
    return max(1.3 * float(_spacing(points)), 1e-4)


@compiled
def _spacing(points):  # type: ignore[no-untyped-def]
    spacing = np.empty(len(points.rows))
    for b in range(len(spacing)):
        corners, place = points.boxes[b // GROUP], b % GROUP
        x, y, z = (
            corners[3, place] - corners[0, place], corners[4, place] - corners[1, place],
            corners[5, place] - corners[2, place],
        )  # fmt: skip
        longest = max(x, y, z)
        middle = x + y + z - longest - min(x, y, z)
        spacing[b] = max(np.sqrt(middle * longest / SIZE), longest / SIZE)
    return np.median(spacing)


@compiled
def _weigh(begin, end, squared, weights):  # type: ignore[no-untyped-def]
    least = np.float32(_CLOSEST)
    for q in range(begin, end):
        one, other, third = (
            np.float32(1.0) / max(squared[q, 0], least), np.float32(1.0) / max(squared[q, 1], least),
            np.float32(1.0) / max(squared[q, 2], least),
        )  # fmt: skip
        total = one + other + third
        weights[q, 0], weights[q, 1], weights[q, 2] = one / total, other / total, third / total


@compiled
def _search(begin, end, queries, points, usual, indices, squared):  # type: ignore[no-untyped-def]
    most = min(3, points.number)
    places, found = np.empty(points.number, np.int32), np.empty(len(points.rows), np.int64)
    rows, at = np.empty(points.number, np.int32), np.empty((3, points.number), np.float32)
    near, nearest = np.empty((3, SIZE), np.float32), np.empty((3, SIZE), np.int32)
    x, y, z = at[0], at[1], at[2]
    d0, d1, d2 = near[0], near[1], near[2]
    n0, n1, n2 = nearest[0], nearest[1], nearest[2]
    for b in range(begin, end):
        qx, qy, qz = queries.points[b, 0], queries.points[b, 1], queries.points[b, 2]
        reach = usual
        while True:
            n = near_bucket(queries, b, points, np.float32(reach * reach), found, places)
            if n < most:
                reach *= 2.0
                continue
            _sort(places[:n], points.rows)
            for p in range(n):
                c, i = places[p] // SIZE, places[p] % SIZE
                rows[p] = points.rows[c, i]
                x[p], y[p], z[p] = points.points[c, 0, i], points.points[c, 1, i], points.points[c, 2, i]
            near[:], nearest[:] = np.inf, 0
            for p in range(n):
                px, py, pz, row = x[p], y[p], z[p], rows[p]
                for i in range(SIZE):
                    dx, dy, dz = px - qx[i], py - qy[i], pz - qz[i]
                    d, a0, a1, a2, m0, m1, m2 = (
                        dx * dx + dy * dy + dz * dz, d0[i], d1[i], d2[i], n0[i], n1[i], n2[i]
                    )  # fmt: skip
                    d2[i] = a1 if d < a1 else (d if d < a2 else a2)
                    n2[i] = m1 if d < a1 else (row if d < a2 else m2)
                    d1[i] = a0 if d < a0 else (d if d < a1 else a1)
                    n1[i] = m0 if d < a0 else (row if d < a1 else m1)
                    d0[i] = d if d < a0 else a0
                    n0[i] = row if d < a0 else m0
            # Points farther than the reach from the bucket were not looked at.
            if n == points.number or near[most - 1].max() <= reach * reach:
                break
            reach *= 2.0
        for i in range(SIZE):
            row = queries.rows[b, i]
            for k in range(3):
                indices[row, k], squared[row, k] = nearest[k, i], near[k, i]


@compiled
def _sort(places, rows):  # type: ignore[no-untyped-def]
    """By row: of equally near points the first one counts as nearer."""
    if len(places) > _FEW:
        own = np.empty(len(places), np.int32)
        for p in range(len(places)):
            own[p] = rows[places[p] // SIZE, places[p] % SIZE]
        places[:] = places[np.argsort(own)]
        return
    for p in range(1, len(places)):
        place, e = places[p], p - 1
        row = rows[place // SIZE, place % SIZE]
        while e >= 0 and rows[places[e] // SIZE, places[e] % SIZE] > row:
            places[e + 1] = places[e]
            e -= 1
        places[e + 1] = place
