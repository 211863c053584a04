"""What the kernels for GPUs compute, against the operations on a CPU: run by test_gpu.py."""

import itertools

import pytest
import torch

from regnet_core.ops.ball_query import ball_query
from regnet_core.ops.box_query import Boxes, box_query
from regnet_core.ops.farthest_points import farthest_points_in_torch
from regnet_core.ops.gpu.farthest_points import farthest_points_on_gpu
from regnet_core.ops.gpu.moments import covariance_on_gpu
from regnet_core.ops.gpu.nearest import three_nearest_on_gpu
from regnet_core.ops.gpu.queries import ball_query_on_gpu, box_query_on_gpu
from regnet_core.ops.gpu.segments import SegmentMaxOnGpu
from regnet_core.ops.interpolation import three_nearest_in_torch
from regnet_core.ops.local_shape import covariance_in_torch
from regnet_core.ops.neighbourhoods import Neighbourhoods
from regnet_core.ops.segments import neighbour_max, segment_max

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
"""Without a GPU Triton interprets the kernels, on the tensors of the CPU."""


def cloud(size: int, seed: int = 0) -> torch.Tensor:
    """Points (size, 3) in a cube of 10 cm."""
    return torch.rand(size, 3, generator=torch.Generator().manual_seed(seed)) * 0.1


def same(found: Neighbourhoods, expected: Neighbourhoods) -> bool:
    """Whether all centres have the same neighbours."""
    both = [[sorted(part.tolist()) for part in some.indices.split(some.counts.tolist())] for some in (found, expected)]
    return both[0] == both[1]


@pytest.mark.parametrize(("size", "count", "start"), [(1, 1, 0), (9, 9, 4), (5000, 60, 3)])
def test_farthest_points(size: int, count: int, start: int) -> None:
    points = cloud(size)
    drawn = farthest_points_on_gpu(points.to(DEVICE), count, start)
    assert torch.equal(drawn.cpu(), farthest_points_in_torch(points, count, start))


def test_farthest_points_of_a_line_by_hand() -> None:
    line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [7, 0, 0]], device=DEVICE)
    assert farthest_points_on_gpu(line, 3).tolist() == [0, 4, 3]
    # Equally far ones: the first; and a cloud with fewer different points gives some again.
    assert farthest_points_on_gpu(line[[2, 1, 3, 2]], 4).tolist()[:3] == [0, 1, 2]


@pytest.mark.parametrize("most", [1, 7, 2000])
def test_ball_query(most: int) -> None:
    points, radius = cloud(1500), 0.02
    centres = torch.cat([points[:9], torch.full((1, 3), 5.0)])
    found = ball_query_on_gpu(points.to(DEVICE), centres.to(DEVICE), radius, most)
    assert same(found, ball_query(points, centres, radius, most))
    assert found.counts.tolist()[-1] == 0 and found.counts.max() >= min(most, 8)


def test_the_surface_of_a_ball_belongs_to_it() -> None:
    points = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0.5000001, 0, 0]], device=DEVICE)
    assert ball_query_on_gpu(points, points[:1], 0.5, 5).indices.tolist() == [0, 1]


@pytest.mark.parametrize("most", [3, 2000])
def test_box_query(most: int) -> None:
    generator = torch.Generator().manual_seed(1)
    points = cloud(1500)
    rotation = torch.linalg.qr(torch.randn(8, 3, 3, generator=generator)).Q
    lower = -0.03 * torch.rand(8, 3, generator=generator)
    boxes = Boxes(rotation, points[:8], lower, lower + 0.04)
    found = box_query_on_gpu(
        points.to(DEVICE), rotation.to(DEVICE), boxes.middle().to(DEVICE), boxes.half().to(DEVICE), most
    )
    expected = box_query(points, boxes, most)
    assert same(found, expected)
    assert expected.counts.max() >= min(most, 20)


@pytest.mark.parametrize(("few", "queries"), [(1, 5), (2, 5), (3, 1), (150, 200)])
def test_three_nearest(few: int, queries: int) -> None:
    points, asked = cloud(few), torch.cat([cloud(few), cloud(200, seed=1)])[:queries]
    indices, squared = three_nearest_on_gpu(points.to(DEVICE), asked.to(DEVICE))
    expected, distances = three_nearest_in_torch(points, asked)
    assert torch.equal(indices.cpu(), expected)
    torch.testing.assert_close(squared.cpu(), distances, atol=0.0, rtol=1e-12)


def test_of_equally_near_points_the_first_counts() -> None:
    points = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], device=DEVICE)
    assert three_nearest_on_gpu(points, torch.zeros(1, 3, device=DEVICE))[0].tolist() == [[0, 1, 2]]


def test_covariances() -> None:
    points = torch.cat([cloud(300), torch.full((1, 3), 5.0)])
    covariance = covariance_on_gpu(points.to(DEVICE), 0.02).cpu()
    expected = covariance_in_torch(points, 0.02)
    torch.testing.assert_close(covariance, expected, atol=1e-9, rtol=1e-4)
    assert covariance[-1].abs().max() == 0.0 and expected.abs().max() > 1e-5


@pytest.mark.parametrize(
    ("dtype", "gathered"), list(itertools.product([torch.float32, torch.bfloat16, torch.float16], [False, True]))
)
def test_segment_max_and_its_gradient(dtype: torch.dtype, gathered: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    offsets = torch.tensor([0, 0, 4, 9, 9, 20, 30])
    indices = torch.randint(0, 30, (30,), generator=generator)
    # Numbers that all types hold, no two of a channel equal; the second block of channels is not whole.
    values = (torch.rand(30, 150, generator=generator).argsort(dim=0) - 15).to(dtype)
    grad = torch.randint(-8, 8, (6, 150), generator=generator).to(dtype)
    ours, theirs = values.clone().to(DEVICE).requires_grad_(), values.float().clone().requires_grad_()
    rows = indices.to(DEVICE) if gathered else None
    top = SegmentMaxOnGpu.apply(ours, rows, offsets.to(DEVICE))
    expected = neighbour_max(theirs, Neighbourhoods(indices, offsets)) if gathered else segment_max(theirs, offsets)
    assert top.dtype == dtype and torch.equal(top.cpu().float(), expected)
    assert top[0].abs().max() == 0.0
    top.backward(grad.to(DEVICE))
    expected.backward(grad.float())
    assert ours.grad is not None and theirs.grad is not None and ours.grad.dtype == dtype
    assert torch.equal(ours.grad.cpu().float(), theirs.grad)


def test_nothing_in_nothing_out() -> None:
    none, some = torch.zeros(0, 3, device=DEVICE), cloud(5).to(DEVICE)
    assert len(ball_query_on_gpu(some, none, 0.1, 3).indices) == 0
    assert ball_query_on_gpu(none, some, 0.1, 3).offsets.tolist() == [0] * 6
    assert len(three_nearest_on_gpu(some, none)[0]) == 0
    assert covariance_on_gpu(none, 0.1).shape == (0, 3, 3)
    top = SegmentMaxOnGpu.apply(none.requires_grad_(), None, torch.zeros(3, dtype=torch.int64, device=DEVICE))
    top.sum().backward()
    assert top.tolist() == [[0.0] * 3] * 2


@pytest.mark.skipif(DEVICE == "cpu", reason="there is no GPU")
def test_the_network_gives_the_same_on_a_gpu() -> None:
    from regnet_core.nn.clouds import Clouds
    from regnet_core.nn.network import RegNet
    from regnet_core.nn.zoo import network_config

    torch.manual_seed(0)
    network = RegNet(network_config("regnetv2-s").replace(least_confidence=0.0)).eval()
    clouds = Clouds.of([cloud(3000), cloud(2000, seed=1)], [0.06, 0.1])
    with torch.inference_mode():
        expected = network(clouds).proposed
        found = network.to(DEVICE)(clouds.to(DEVICE)).proposed
    for level, other in zip(found.hierarchy.levels, expected.hierarchy.levels, strict=True):
        assert torch.equal(level.source.cpu(), other.source)
        assert same(level.neighbours, other.neighbours)
        assert torch.equal(level.interpolation.indices.cpu(), other.interpolation.indices)
    torch.testing.assert_close(found.confidence.cpu(), expected.confidence, atol=1e-3, rtol=1e-3)
