"""Segment maxima: values and gradients, for every type and against torch."""

import pytest
import torch

from regnet_core.ops.neighbourhoods import Neighbourhoods
from regnet_core.ops.segments import neighbour_max, rectified_segment_max, segment_max, segment_max_in_torch

TYPES = [torch.float32, torch.bfloat16, torch.float64]


@pytest.mark.parametrize("dtype", TYPES)
def test_by_hand(dtype: torch.dtype) -> None:
    values = torch.tensor([[1.0, -5], [3, -2], [-4, -0.5], [-0.25, -7]], dtype=dtype)
    expected = torch.tensor([[3.0, -2], [0, 0], [-0.25, -0.5]], dtype=dtype)
    assert torch.equal(segment_max(values, torch.tensor([0, 2, 2, 4])), expected)


@pytest.mark.parametrize("dtype", TYPES)
def test_the_largest_gets_the_gradient(dtype: torch.dtype) -> None:
    values = torch.tensor([[1.0, -5], [3, -2], [-4, -0.5], [-0.25, -7]], dtype=dtype, requires_grad=True)
    grad = torch.tensor([[1.0, 2], [3, 4], [5, 6]], dtype=dtype)
    segment_max(values, torch.tensor([0, 2, 2, 4])).backward(grad)
    assert values.grad is not None and values.grad.dtype == dtype
    assert values.grad.tolist() == [[0, 0], [1, 2], [0, 6], [5, 0]]


@pytest.mark.parametrize("dtype", TYPES)
def test_points_shared_by_neighbourhoods_add_their_gradients_up(dtype: torch.dtype) -> None:
    values = torch.tensor([[1.0], [3], [2]], dtype=dtype, requires_grad=True)
    neighbours = Neighbourhoods(torch.tensor([0, 1, 1, 2, 0]), torch.tensor([0, 2, 4, 4, 5]))
    top = neighbour_max(values, neighbours)
    assert top.flatten().tolist() == [3, 3, 0, 1]
    top.backward(torch.tensor([[1.0], [10], [100], [1000]], dtype=dtype))
    assert values.grad is not None and values.grad.flatten().tolist() == [1000, 11, 0]


@pytest.mark.parametrize("dtype", TYPES)
def test_without_gradients_the_largest_are_the_same(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(1)
    offsets = ragged(generator)
    values = torch.randn(900, 37, generator=generator).to(dtype)[:, :35]
    near = Neighbourhoods(torch.randint(0, 900, (int(offsets[-1]),), generator=generator), offsets)
    expected = neighbour_max(values, near)
    with torch.no_grad():
        assert torch.equal(neighbour_max(values, near), expected)


def test_of_equal_values_the_first_gets_the_gradient() -> None:
    values = torch.zeros(3, 1, requires_grad=True)
    segment_max(values, torch.tensor([0, 3])).sum().backward()
    assert values.grad is not None and values.grad.flatten().tolist() == [1, 0, 0]


def ragged(generator: torch.Generator) -> torch.Tensor:
    counts = torch.randint(0, 9, (2000,), generator=generator)
    return torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])


@pytest.mark.parametrize("channels", [1, 37, 256])
def test_kernels_equal_torch(channels: int) -> None:
    generator = torch.Generator().manual_seed(0)
    offsets = ragged(generator)
    rows = int(offsets[-1])
    # No two values of a channel are equal: torch would share the gradient.
    values = torch.rand(rows, channels, generator=generator).argsort(dim=0).float() - rows / 2
    segment = torch.repeat_interleave(torch.arange(2000), offsets.diff())
    indices = (torch.arange(rows) - offsets[segment] + 2 * segment) % rows  # segments share rows, none has one twice
    grad = torch.randn(len(offsets) - 1, channels, generator=generator)
    for gathered in (False, True):
        own, other = values.clone().requires_grad_(), values.clone().requires_grad_()
        neighbours = Neighbourhoods(indices, offsets)
        top = neighbour_max(own, neighbours) if gathered else segment_max(own, offsets)
        expected = segment_max_in_torch(other[indices] if gathered else other, offsets)
        assert torch.equal(top, expected)
        top.backward(grad)
        expected.backward(grad)
        torch.testing.assert_close(own.grad, other.grad)


def test_bfloat16_does_what_float32_does() -> None:
    generator = torch.Generator().manual_seed(0)
    offsets = ragged(generator)
    rows = int(offsets[-1])
    low = torch.randn(rows, 16, generator=generator).bfloat16().requires_grad_()
    high = low.detach().float().requires_grad_()
    neighbours = Neighbourhoods(torch.randint(0, rows, (rows,), generator=generator), offsets)
    grad = torch.randn(len(offsets) - 1, 16, generator=generator).bfloat16()
    for reduce in (lambda v: neighbour_max(v, neighbours), lambda v: segment_max(v, offsets)):
        low.grad = high.grad = None
        top, expected = reduce(low), reduce(high)
        assert top.dtype == torch.bfloat16 and torch.equal(top.float(), expected)
        top.backward(grad)
        expected.backward(grad.float())
        assert low.grad is not None and high.grad is not None
        torch.testing.assert_close(low.grad, high.grad.bfloat16())


def test_values_that_are_not_contiguous() -> None:
    values = torch.randn(4, 6, generator=torch.Generator().manual_seed(0)).t()
    assert torch.equal(segment_max(values, torch.tensor([0, 6])), values.max(dim=0, keepdim=True).values)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_rectified_maximum_is_the_rectifier_of_the_maximum(dtype: torch.dtype) -> None:
    values = torch.randn(200, 33, generator=torch.Generator().manual_seed(3)).to(dtype) - 1.0
    offsets = torch.tensor([0, 0, 5, 6, 120, 120, 200])
    expected = torch.relu(segment_max_in_torch(values, offsets))
    assert torch.equal(rectified_segment_max(values, offsets), expected)
    assert (expected == 0).any() and (expected > 0).any() and (expected[[0, 4]] == 0).all()
