"""Maxima over segments of rows, gathered or not: nothing is copied together first."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl

_CHANNELS = 128
"""The most channels of a program."""


class SegmentMaxOnGpu(torch.autograd.Function):
    """``ops.segments.segment_max``, with indices ``neighbour_max``: (values, indices or None, offsets) -> (S, C)."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, values: torch.Tensor, indices: torch.Tensor | None, offsets: torch.Tensor
    ) -> torch.Tensor:
        top, rows = max_on_gpu(values.detach(), indices, offsets)
        ctx.save_for_backward(rows)
        ctx.shape = values.shape
        return top

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        (rows,) = ctx.saved_tensors
        # Nothing goes anywhere from an empty segment. A row may be the largest of several: sums are in float32.
        grad = torch.where(rows >= 0, grads[0].float(), 0.0)
        total = torch.zeros(ctx.shape, dtype=torch.float32, device=grad.device)
        if len(total) > 0:
            total.scatter_add_(0, rows.clamp(min=0), grad)
        return total.to(grads[0].dtype), None, None


def max_on_gpu(
    values: torch.Tensor, indices: torch.Tensor | None, offsets: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The largest value of each channel in each segment (S, C), 0 where it is empty, and the row that it is of.

    Args:
        values: (N, C), float32, bfloat16 or float16.
        indices: (E,) int64, rows of the values that the segments are of; None: the rows in their order.
        offsets: (S + 1,) int64.

    Returns:
        (S, C) of the values' type, and (S, C) int64, the first of equal ones, -1 where the segment is empty.
    """
    values = values.contiguous()
    segments, channels = len(offsets) - 1, values.shape[1]
    top = values.new_empty((segments, channels))
    rows = torch.empty((segments, channels), dtype=torch.int64, device=values.device)
    if segments > 0 and channels > 0:
        block = min(_CHANNELS, triton.next_power_of_2(channels))
        largest[(segments, triton.cdiv(channels, block))](
            values, offsets if indices is None else indices, offsets, top, rows, channels,
            GATHERED=indices is not None, BLOCK=block,
        )  # fmt: skip
    return top, rows


@triton.jit
def largest(values, indices, offsets, top, rows, channels, GATHERED: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """A program for each segment and block of channels."""
    segment = tl.program_id(0).to(tl.int64)
    lanes = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    there = lanes < channels
    first, last = tl.load(offsets + segment), tl.load(offsets + segment + 1)
    best = tl.full((BLOCK,), float("-inf"), tl.float32)
    where = tl.full((BLOCK,), -1, tl.int64)
    for e in range(first, last):
        row = e
        if GATHERED:
            row = tl.load(indices + e)
        value = tl.load(values + row * channels + lanes, mask=there, other=0.0).to(tl.float32)
        larger = (value > best) | (where < 0)
        best = tl.where(larger, value, best)
        where = tl.where(larger, row, where)
    best = tl.where(where < 0, 0.0, best)
    tl.store(top + segment * channels + lanes, best.to(top.dtype.element_ty), mask=there)
    tl.store(rows + segment * channels + lanes, where, mask=there)
