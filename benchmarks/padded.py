"""The plain way to run the network, for comparison: padded neighbourhoods, and every layer on every neighbour.

Neighbourhoods with fewer than K points repeat their first one, as the published code does. Everything is one cloud, in
fp32, by brute force, and layer by layer as the modules are written down: nothing is folded or computed in parts. The
tests hold the network against it for what it computes, benchmarks/reference.py for how long it takes.

Searches go through the centres in chunks, so that a cloud of the paper's size fits into memory.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple, cast

import torch
from torch import nn

from regnet_core.gripper import Gripper
from regnet_core.nn.clouds import Clouds, point_features, width_feature
from regnet_core.nn.layers import DenseLayer, Mlp
from regnet_core.nn.network import RegNet
from regnet_core.nn.propagation import FeaturePropagation
from regnet_core.nn.results import Candidates
from regnet_core.nn.set_abstraction import SetAbstraction
from regnet_core.ops.farthest_points import farthest_points

_CHUNK = 1 << 23
"""Pairs of a centre and a point that are looked at in one go."""


class Nearest(NamedTuple):
    """The three nearest points of each query."""

    indices: torch.Tensor
    """(Q, 3)."""
    weights: torch.Tensor
    """(Q, 3): inverse squared distances, scaled to a sum of 1."""


def run_mlp(mlp: Mlp, rows: torch.Tensor) -> torch.Tensor:
    """(..., C_in) -> (..., C_out), through the modules themselves so that hooks see what passes."""
    shape = rows.shape
    rows = rows.reshape(-1, shape[-1])
    for layer in mlp:
        dense = cast(DenseLayer, layer)
        rows = torch.relu(dense.norm(dense.linear(rows)))
    return rows.reshape(*shape[:-1], -1)


def padded_ball_query(points: torch.Tensor, centres: torch.Tensor, radius: float, most: int) -> torch.Tensor:
    """(C, K): the first K points within the radius, and the first one again where there are fewer."""
    parts = []
    for some in _chunks(centres, len(points)):
        near = torch.cdist(some.double(), points.double(), compute_mode="donot_use_mm_for_euclid_dist") <= radius
        parts.append(_first(near, most))
    return torch.cat(parts)


def _chunks(rows: torch.Tensor, others: int) -> tuple[torch.Tensor, ...]:
    return rows.split(max(1, _CHUNK // max(1, others)))


def _first(chosen: torch.Tensor, most: int) -> torch.Tensor:
    """(C, K): the numbers of the first K chosen ones (C, N) of each row, filled up with the first; N where none is."""
    count = chosen.shape[1]
    numbers = torch.where(chosen, torch.arange(count, dtype=torch.int32), count)
    first = numbers.topk(min(most, count), dim=1, largest=False).values.long()
    if most > count:
        first = torch.cat([first, first[:, :1].expand(-1, most - count)], dim=1)
    return torch.where(first == count, first[:, :1], first)


def plain_farthest_points(points: torch.Tensor, count: int, start: int = 0) -> torch.Tensor:
    """One at a time, by the definition: each is the one farthest from the nearest of those before it."""
    drawn = [start]
    nearest = (points - points[start]).square().sum(-1)
    while len(drawn) < min(count, len(points)):
        drawn.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, (points - points[drawn[-1]]).square().sum(-1))
    return torch.tensor(drawn)


def nearest_three(points: torch.Tensor, queries: torch.Tensor) -> Nearest:
    """The three of points (N, 3) that are nearest to each of queries (Q, 3)."""
    indices, weights = [], []
    for some in _chunks(queries, len(points)):
        distance = torch.cdist(some.double(), points.double(), compute_mode="donot_use_mm_for_euclid_dist")
        found = distance.square().topk(3, dim=1, largest=False)
        weight = 1.0 / found.values.clamp(min=1e-10)
        indices.append(found.indices)
        weights.append(weight / weight.sum(dim=1, keepdim=True))
    return Nearest(torch.cat(indices), torch.cat(weights))


def plain_interpolation(values: torch.Tensor, points: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    """(Q, C): the mean over the three nearest points, weighted by inverse squared distances."""
    return interpolated(values, nearest_three(points, queries))


def interpolated(values: torch.Tensor, nearest: Nearest) -> torch.Tensor:
    """(Q, C) of values (N, C)."""
    return (values[nearest.indices] * nearest.weights.to(values.dtype)[..., None]).sum(dim=1)


def plain_shapes(points: torch.Tensor, radius: float) -> torch.Tensor:
    """(N, 3, 3): 3 C / trace(C) - 1, from the mean and the covariance of each point's neighbours."""
    parts, at = [], points.double() - points.double().mean(dim=0)
    for some in _chunks(at, len(at)):
        near = torch.cdist(some, at, compute_mode="donot_use_mm_for_euclid_dist") <= radius
        share = near.double() / near.sum(dim=1, keepdim=True)
        mean = share @ at
        outer = (at[:, :, None] * at[:, None, :]).flatten(1)
        covariance = (share @ outer).unflatten(1, (3, 3)) - mean[:, :, None] * mean[:, None, :]
        trace = covariance.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None]
        shape = 3.0 * covariance / trace.clamp(min=1e-8) - torch.eye(3, dtype=torch.float64)
        parts.append(torch.where(trace >= 1e-8, shape, torch.zeros_like(shape)))
    return torch.cat(parts).float()


def with_plain_shapes(network: RegNet, clouds: Clouds) -> Clouds:
    """The one cloud with its local shapes, where the network wants them and the cloud has none yet."""
    radius = network.config.shape_radius
    if radius == 0.0 or clouds.shapes is not None:
        return clouds
    return clouds._replace(shapes=plain_shapes(clouds.points, radius))


def backbone_features(network: RegNet, clouds: Clouds) -> torch.Tensor:
    """(N, C) of the one cloud."""
    clouds = with_plain_shapes(network, clouds)
    start = int(farthest_points(clouds.points, 1))  # which point comes first is not defined
    config, backbone = network.config, network.backbone
    points, own = [clouds.points], point_features(clouds, config)
    features: list[torch.Tensor | None] = [own]
    for module, abstraction in zip(backbone.abstractions, config.abstractions, strict=True):
        centroids = points[-1][plain_farthest_points(points[-1], abstraction.centroids, start)]
        start = 0
        index = padded_ball_query(points[-1], centroids, abstraction.radius, abstraction.neighbours)
        grouped = (points[-1][index] - centroids[:, None]) / abstraction.radius
        if features[-1] is not None:
            grouped = torch.cat([grouped, features[-1][index]], dim=-1)
        features.append(run_mlp(cast(SetAbstraction, module).mlp, grouped).max(dim=1).values)
        points.append(centroids)
    nearest = [nearest_three(coarse, fine) for fine, coarse in pairwise(points)]
    offset = (points[0] - interpolated(points[1], nearest[0])) / config.abstractions[0].radius
    features[0] = offset if own is None else torch.cat([offset, own], dim=1)
    carried = cast(torch.Tensor, features[-1])
    for i, module in zip(range(len(points) - 2, -1, -1), backbone.propagations, strict=True):
        joined = torch.cat([interpolated(carried, nearest[i]), cast(torch.Tensor, features[i])], dim=1)
        carried = run_mlp(cast(FeaturePropagation, module).mlp, joined)
    return carried


def confidence(network: RegNet, features: torch.Tensor) -> torch.Tensor:
    """Logits (N,)."""
    return cast(torch.Tensor, network.score.output(run_mlp(network.score.mlp, features))).squeeze(1)


def region_features(network: RegNet, clouds: Clouds, features: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """(R, C) of regions around points with numbers (R,)."""
    if network.config.region is None:
        return features[centres]
    region = network.config.region
    index = padded_ball_query(clouds.points, clouds.points[centres], region.radius, region.points)
    return features[index].max(dim=1).values


def anchor_numbers(network: RegNet, pooled: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Logits (R, M) and the other numbers (R, M, 9)."""
    head = network.grasp
    for_class = run_mlp(head.class_mlp or network.score.mlp, pooled)
    for_residual = run_mlp(head.residual_mlp, pooled) if head.residual_mlp is not None else for_class
    return head.class_output(for_class), head.residual_output(for_residual).view(len(pooled), -1, 9)


def closing_index(network: RegNet, clouds: Clouds, candidates: Candidates, gripper: Gripper) -> torch.Tensor:
    """(G, K): points of the closing areas of G candidates; any where an area is empty."""
    config = network.config.refinement
    assert config is not None
    pose, margin = candidates.pose, config.margin
    low = torch.tensor([0.0, -float(clouds.width) / 2, -gripper.height / 2]) - margin
    high = torch.tensor([gripper.depth, float(clouds.width) / 2, gripper.height / 2]) + margin
    parts = []
    for some in _chunks(torch.arange(len(candidates.region)), 3 * len(clouds.points)):
        local = (clouds.points[None] - pose.translation[some, None]) @ pose.rotation[some]  # (g, N, 3)
        parts.append(_first(((local > low) & (local < high)).all(dim=-1), config.points))
    return torch.cat(parts).clamp(max=len(clouds.points) - 1)


def refined_numbers(
    network: RegNet,
    clouds: Clouds,
    features: torch.Tensor,
    pooled: torch.Tensor,
    candidates: Candidates,
    gripper: Gripper,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Logits (G,) and the other numbers (G, 9); nonsense where a closing area is empty."""
    module, config = network.refinement, network.config
    assert module is not None and config.refinement is not None
    pose = candidates.pose
    index = closing_index(network, clouds, candidates, gripper)
    local = (clouds.points[index] - pose.translation[:, None]) @ pose.rotation
    parts = [local / 0.03]
    if config.width:
        parts.append(width_feature(clouds.width).expand(*index.shape, 1))
    if config.colour:
        assert clouds.colors is not None
        parts.append(clouds.colors[index] * 2.0 - 1.0)
    shapes = with_plain_shapes(network, clouds).shapes
    if shapes is not None:
        turned = pose.rotation.transpose(1, 2)[:, None] @ shapes[index] @ pose.rotation[:, None]
        parts.append(turned[..., (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)])
    if config.refinement.point_features:
        parts.append(features[index])
    seen = run_mlp(module.mlp, torch.cat(parts, dim=-1)).max(dim=1).values
    both = torch.cat([seen, pooled[candidates.region]], dim=1)
    if isinstance(module.fusion, Mlp):
        both = run_mlp(module.fusion, both)
    return module.class_output(both).squeeze(1), module.residual_output(both)


def randomise_norms(module: nn.Module, seed: int) -> None:
    """Give batch normalisations statistics and weights that make a difference."""
    generator = torch.Generator().manual_seed(seed)
    for norm in module.modules():
        if isinstance(norm, nn.BatchNorm1d):
            size = norm.num_features
            norm.running_mean = torch.randn(size, generator=generator) * 0.3
            norm.running_var = torch.rand(size, generator=generator) + 0.5
            norm.weight.data = torch.randn(size, generator=generator)  # some negative
            norm.bias.data = torch.randn(size, generator=generator) * 0.3
