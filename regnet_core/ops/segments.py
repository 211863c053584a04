"""Maxima over segments of rows, of different lengths; with gradients.

Compiled kernels do the work: on a CPU for float32 and bfloat16, on a GPU for float16 too. For other types torch does.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch

from regnet_core.ops.arrays import as_array
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels
from regnet_core.ops.neighbourhoods import Neighbourhoods
from regnet_core.ops.parallel import for_each_range


def neighbour_max(values: torch.Tensor, neighbours: Neighbourhoods) -> torch.Tensor:
    """The largest value of each channel among the neighbours, for values (N, C) of the points -> (centres, C).

    A centre without neighbours gets 0. Of equal values the first one gets the gradient.
    """
    if has_kernel(values) and values.dtype == torch.float32 and not torch.is_grad_enabled():
        return _largest_of(values, neighbours)
    if (largest := _kernel_for(values)) is not None:
        return cast(torch.Tensor, largest.apply(values, neighbours.indices, neighbours.offsets))
    return segment_max_in_torch(values.index_select(0, neighbours.indices), neighbours.offsets)


def _largest_of(values: torch.Tensor, neighbours: Neighbourhoods) -> torch.Tensor:
    """``neighbour_max`` where nobody asks which neighbour has the largest value."""
    top = values.new_empty((len(neighbours.offsets) - 1, values.shape[1]))
    source, target = as_array(values), as_array(top)
    rows, bounds = neighbours.indices.numpy(), neighbours.offsets.numpy()
    each = 0.1 * len(rows) * values.shape[1] / max(len(top), 1)
    for_each_range(_gather_largest, len(top), each, source, rows, bounds, target)
    return top


def segment_max(values: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    """The largest value of each channel in each segment, for values (E, C) and offsets (S + 1,) -> (S, C).

    An empty segment gets 0. Of equal values the first one gets the gradient.
    """
    if (largest := _kernel_for(values)) is not None:
        return cast(torch.Tensor, largest.apply(values, None, offsets))
    return segment_max_in_torch(values, offsets)


def rectified_segment_max(values: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    """The largest value of each channel in each segment, or 0 where none is above it -> (S, C); without gradients."""
    if not has_kernel(values):
        return torch.relu_(segment_max(values, offsets))
    top = values.new_zeros((len(offsets) - 1, values.shape[1]))
    source, target, bounds = as_array(values), as_array(top), offsets.numpy()
    for_each_range(_raise, len(top), 0.1 * values.numel() / max(len(top), 1), source, bounds, target)
    return top


def segment_max_in_torch(values: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    """``segment_max`` on any device; equal values share the gradient."""
    top = torch.segment_reduce(values, "max", offsets=offsets, axis=0, unsafe=True)
    return torch.where(offsets.diff()[:, None] > 0, top, torch.zeros((), dtype=values.dtype, device=values.device))


def _kernel_for(values: torch.Tensor) -> type[torch.autograd.Function] | None:
    """What computes maxima of such values, with gradients, on their device; None where only torch does."""
    if has_kernel(values):
        return _SegmentMax
    if has_kernels(values) and values.dtype in (torch.float32, torch.bfloat16, torch.float16):
        from regnet_core.ops.gpu.segments import SegmentMaxOnGpu

        return SegmentMaxOnGpu
    return None


def has_kernel(values: torch.Tensor) -> bool:
    """Whether compiled kernels for CPUs work on such values."""
    return values.device.type == "cpu" and values.dtype in (torch.float32, torch.bfloat16)


class _SegmentMax(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, values: torch.Tensor, indices: torch.Tensor | None, offsets: torch.Tensor
    ) -> torch.Tensor:
        segments, channels = len(offsets) - 1, values.shape[1]
        top = values.new_empty((segments, channels))
        rows = torch.empty((segments, channels), dtype=torch.int32)
        source, target = as_array(values), as_array(top)
        index = np.zeros(0, np.int64) if indices is None else indices.numpy()
        bounds, chosen = offsets.numpy(), rows.numpy()
        kernel = _max_of_bits if values.dtype == torch.bfloat16 else _max_of_floats
        rows_of_all = len(values) if indices is None else len(indices)
        each = 0.2 * rows_of_all * channels / max(segments, 1)
        for_each_range(kernel, segments, each, source, index, indices is not None, bounds, target, chosen)
        ctx.save_for_backward(rows)
        ctx.shape, ctx.shared = values.shape, indices is not None
        return top

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        (rows,) = ctx.saved_tensors
        backward = _backward_of_shared if ctx.shared else _backward_of_own
        return backward(grads[0], rows.numpy(), ctx.shape), None, None


def _backward_of_own(grad: torch.Tensor, rows: npt.NDArray[Any], shape: torch.Size) -> torch.Tensor:
    """Each row belongs to one segment: what reaches it is copied."""
    total = torch.zeros(shape, dtype=grad.dtype)
    source, target = as_array(grad), as_array(total)
    for_each_range(_copy_back, len(rows), 1.0 * shape[1], source, rows, target)
    return total


def _backward_of_shared(grad: torch.Tensor, rows: npt.NDArray[Any], shape: torch.Size) -> torch.Tensor:
    """A row may be the largest of several segments: what reaches it is added up, split by channels."""
    total = torch.zeros(shape, dtype=torch.float32)
    source, target = grad.float().contiguous().numpy(), total.numpy()
    for_each_range(_add_back, shape[1], 1.0 * len(rows), source, rows, target)
    return total.to(grad.dtype)


@compiled
def _max_of_floats(begin, end, values, indices, gathered, offsets, top, rows):  # type: ignore[no-untyped-def]
    channels = values.shape[1]
    for s in range(begin, end):
        first, last = offsets[s], offsets[s + 1]
        if first == last:
            top[s] = 0.0
            rows[s] = -1
            continue
        row = indices[first] if gathered else first
        for c in range(channels):
            top[s, c] = values[row, c]
            rows[s, c] = row
        for e in range(first + 1, last):
            row = indices[e] if gathered else e
            r = np.int32(row)
            for c in range(channels):
                value = values[row, c]
                larger = value > top[s, c]
                top[s, c] = value if larger else top[s, c]
                rows[s, c] = r if larger else rows[s, c]


@compiled
def _max_of_bits(begin, end, values, indices, gathered, offsets, top, rows):  # type: ignore[no-untyped-def]
    """The same for the bits of bfloat16: those of negative numbers sort backwards as integers, all but the sign."""
    channels = values.shape[1]
    for s in range(begin, end):
        first, last = offsets[s], offsets[s + 1]
        if first == last:
            top[s] = 0
            rows[s] = -1
            continue
        row = indices[first] if gathered else first
        for c in range(channels):
            value = values[row, c]
            top[s, c] = value ^ ((value >> 15) & 0x7FFF)
            rows[s, c] = row
        for e in range(first + 1, last):
            row = indices[e] if gathered else e
            r = np.int32(row)
            for c in range(channels):
                value = values[row, c]
                key = np.int16(value ^ ((value >> 15) & 0x7FFF))
                larger = key > top[s, c]
                top[s, c] = key if larger else top[s, c]
                rows[s, c] = r if larger else rows[s, c]
        for c in range(channels):
            key = top[s, c]
            top[s, c] = key ^ ((key >> 15) & 0x7FFF)


@compiled
def _gather_largest(begin, end, values, rows, offsets, top):  # type: ignore[no-untyped-def]
    for s in range(begin, end):
        first, last, own = offsets[s], offsets[s + 1], top[s]
        if first == last:
            own[:] = 0.0
            continue
        own[:] = values[rows[first]]
        for e in range(first + 1, last):
            other = values[rows[e]]
            for c in range(len(own)):
                own[c] = other[c] if other[c] > own[c] else own[c]


@compiled
def _raise(begin, end, values, offsets, top):  # type: ignore[no-untyped-def]
    """Raise ``top``, which is nowhere below 0, to the largest values; bits of bfloat16 above 0 sort like integers."""
    for s in range(begin, end):
        for e in range(offsets[s], offsets[s + 1]):
            for c in range(values.shape[1]):
                top[s, c] = max(top[s, c], values[e, c])


@compiled
def _copy_back(begin, end, grad, rows, total):  # type: ignore[no-untyped-def]
    for s in range(begin, end):
        if rows[s, 0] >= 0:
            for c in range(grad.shape[1]):
                total[rows[s, c], c] = grad[s, c]


@compiled
def _add_back(begin, end, grad, rows, total):  # type: ignore[no-untyped-def]
    for s in range(len(rows)):
        if rows[s, 0] >= 0:
            for c in range(begin, end):
                total[rows[s, c], c] += grad[s, c]
