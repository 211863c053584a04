"""The shape of the surface around points: known surfaces, and the search on any device."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from regnet_core.ops.buckets import point_buckets
from regnet_core.ops.local_shape import covariance_in_torch, local_shapes, symmetric, turned, unique_entries


def _grid(step: float = 0.002, count: int = 31) -> torch.Tensor:
    line = (torch.arange(count) - count // 2) * step
    return torch.cartesian_prod(line, line, torch.zeros(1))


def _turn(seed: int) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(random_state=seed).as_matrix()).float()


@pytest.mark.parametrize("seed", range(4))
def test_a_flat_surface_says_its_normal_without_a_sign(seed: int) -> None:
    turn, middle = _turn(seed), 31 * 31 // 2
    shape = local_shapes(_grid() @ turn.T + 0.8, 0.0125)[middle]
    normal = turn[:, 2]
    torch.testing.assert_close(shape, 0.5 * torch.eye(3) - 1.5 * torch.outer(normal, normal), atol=2e-3, rtol=0.0)


def test_lines_and_lonely_points() -> None:
    line = torch.stack([torch.zeros(40), torch.zeros(40), torch.arange(40) * 0.001], dim=1)
    shapes = local_shapes(torch.cat([line, torch.tensor([[1.0, 1.0, 1.0]])]), 0.012)
    torch.testing.assert_close(shapes[20], torch.diag(torch.tensor([-1.0, -1.0, 2.0])))
    assert torch.equal(shapes[-1], torch.zeros(3, 3))
    assert local_shapes(torch.zeros(0, 3), 0.01).shape == (0, 3, 3)


def test_the_search_in_torch_finds_the_same() -> None:
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 0.1 + 2.0
    covariance = covariance_in_torch(points, 0.02)
    trace = covariance.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None]
    expected = torch.where(trace >= 1e-8, 3.0 * covariance / trace - torch.eye(3), 0.0).float()
    torch.testing.assert_close(local_shapes(points, 0.02), expected, atol=2e-5, rtol=1e-5)
    assert torch.equal(local_shapes(points, 0.02, point_buckets(points)), local_shapes(points, 0.02))


def test_tensors_turn_into_frames_and_keep_their_entries() -> None:
    generator = torch.Generator().manual_seed(2)
    half = torch.rand(7, 3, 3, generator=generator)
    tensor = half + half.transpose(1, 2)
    assert torch.equal(symmetric(unique_entries(tensor)), tensor)
    rotation = torch.stack([_turn(seed) for seed in range(7)])
    with torch.autocast("cpu", torch.bfloat16):
        seen = turned(tensor, rotation)
    torch.testing.assert_close(seen, rotation.transpose(1, 2) @ tensor @ rotation)
