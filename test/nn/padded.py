"""The plain way to run the network, for comparison: padded neighbourhoods, and every layer on every neighbour.

Neighbourhoods with fewer than K points repeat their first one, as the published code does. Everything is one cloud,
brute force, and layer by layer as the modules are written down: nothing is folded or computed in parts.
"""

from __future__ import annotations

import torch
from torch import nn

from regnet_core.gripper import Gripper
from regnet_core.nn.clouds import Clouds, point_features, width_feature
from regnet_core.nn.layers import Mlp
from regnet_core.nn.network import RegNet
from regnet_core.nn.results import Candidates
from regnet_core.ops.farthest_points import farthest_points


def run_mlp(mlp: Mlp, rows: torch.Tensor) -> torch.Tensor:
    """(..., C_in) -> (..., C_out), through the modules themselves so that hooks see what passes."""
    shape = rows.shape
    rows = rows.reshape(-1, shape[-1])
    for layer in mlp:
        rows = torch.relu(layer.norm(layer.linear(rows)))
    return rows.reshape(*shape[:-1], -1)


def padded_ball_query(points: torch.Tensor, centres: torch.Tensor, radius: float, most: int) -> torch.Tensor:
    """(C, K): the first K points within the radius, and the first one again where there are fewer."""
    near = torch.cdist(centres.double(), points.double(), compute_mode="donot_use_mm_for_euclid_dist") <= radius
    return _first(near, most)


def _first(chosen: torch.Tensor, most: int) -> torch.Tensor:
    numbers = torch.where(chosen, torch.arange(chosen.shape[1]), chosen.shape[1]).sort(dim=1).values[:, :most]
    if numbers.shape[1] < most:
        numbers = torch.cat([numbers, numbers[:, :1].expand(-1, most - numbers.shape[1])], dim=1)
    return torch.where(numbers == chosen.shape[1], numbers[:, :1], numbers)


def plain_farthest_points(points: torch.Tensor, count: int, start: int = 0) -> torch.Tensor:
    """One at a time, by the definition."""
    drawn = [start]
    while len(drawn) < min(count, len(points)):
        nearest = (points[:, None] - points[drawn][None]).square().sum(-1).min(dim=1).values
        drawn.append(int(nearest.argmax()))
    return torch.tensor(drawn)


def plain_interpolation(values: torch.Tensor, points: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    """(Q, C): the mean over the three nearest points, weighted by inverse squared distances."""
    squared = torch.cdist(queries.double(), points.double(), compute_mode="donot_use_mm_for_euclid_dist").square()
    nearest = squared.topk(3, dim=1, largest=False)
    weight = 1.0 / nearest.values.clamp(min=1e-10)
    weight = (weight / weight.sum(dim=1, keepdim=True)).to(values.dtype)
    return (values[nearest.indices] * weight[..., None]).sum(dim=1)


def plain_shapes(points: torch.Tensor, radius: float) -> torch.Tensor:
    """(N, 3, 3): 3 C / trace(C) - 1, one point after the other."""
    shapes = torch.zeros(len(points), 3, 3)
    for row, point in enumerate(points.double()):
        near = points.double()[(points.double() - point).norm(dim=1) <= radius]
        covariance = (near - near.mean(dim=0)).T @ (near - near.mean(dim=0)) / len(near)
        if covariance.trace() >= 1e-8:
            shapes[row] = (3.0 * covariance / covariance.trace() - torch.eye(3)).float()
    return shapes


def with_plain_shapes(network: RegNet, clouds: Clouds) -> Clouds:
    """The one cloud with its local shapes, where the network wants them."""
    radius = network.config.shape_radius
    return clouds._replace(shapes=plain_shapes(clouds.points, radius)) if radius else clouds


def backbone_features(network: RegNet, clouds: Clouds) -> torch.Tensor:
    """(N, C) of the one cloud."""
    clouds = with_plain_shapes(network, clouds)
    start = int(farthest_points(clouds.points, 1))  # which point comes first is not defined
    config, backbone = network.config, network.backbone
    points, own = [clouds.points], point_features(clouds, config)
    features = [own]
    for module, abstraction in zip(backbone.abstractions, config.abstractions, strict=True):
        centroids = points[-1][plain_farthest_points(points[-1], abstraction.centroids, start)]
        start = 0
        index = padded_ball_query(points[-1], centroids, abstraction.radius, abstraction.neighbours)
        grouped = (points[-1][index] - centroids[:, None]) / abstraction.radius
        if features[-1] is not None:
            grouped = torch.cat([grouped, features[-1][index]], dim=-1)
        features.append(run_mlp(module.mlp, grouped).max(dim=1).values)
        points.append(centroids)
    offset = (points[0] - plain_interpolation(points[1], points[1], points[0])) / config.abstractions[0].radius
    features[0] = offset if own is None else torch.cat([offset, own], dim=1)
    carried = features[-1]
    for i, module in zip(range(len(points) - 2, -1, -1), backbone.propagations, strict=True):
        interpolated = plain_interpolation(carried, points[i + 1], points[i])
        carried = run_mlp(module.mlp, torch.cat([interpolated, features[i]], dim=1))
    return carried


def confidence(network: RegNet, features: torch.Tensor) -> torch.Tensor:
    """Logits (N,)."""
    return network.score.output(run_mlp(network.score.mlp, features)).squeeze(1)


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
    pose, margin = candidates.pose, config.refinement.margin
    local = (clouds.points[None] - pose.translation[:, None]) @ pose.rotation  # (G, N, 3)
    low = torch.tensor([0.0, -float(clouds.width) / 2, -gripper.height / 2]) - margin
    high = torch.tensor([gripper.depth, float(clouds.width) / 2, gripper.height / 2]) + margin
    inside = ((local > low) & (local < high)).all(dim=-1)
    index = _first(inside, config.refinement.points).clamp(max=len(clouds.points) - 1)
    parts = [local.gather(1, index[..., None].expand(-1, -1, 3)) / 0.03]
    if config.width:
        parts.append(width_feature(clouds.width).expand(*index.shape, 1))
    if config.colour:
        assert clouds.colors is not None
        parts.append(clouds.colors[index] * 2.0 - 1.0)
    shapes = with_plain_shapes(network, clouds).shapes
    if shapes is not None:
        seen = pose.rotation.transpose(1, 2)[:, None] @ shapes[index] @ pose.rotation[:, None]
        parts.append(seen[..., (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)])
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
