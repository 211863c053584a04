"""The three nearest points of each query: a program for some queries goes through all points once."""

from __future__ import annotations

import torch
import triton
import triton.language as tl

_BLOCK = 128
"""Queries of a program."""


def three_nearest_on_gpu(points: torch.Tensor, queries: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """``ops.interpolation.three_nearest_in_torch``: indices (Q, 3) and squared distances (Q, 3) [m2], nearest first."""
    count = len(queries)
    indices = torch.zeros((3, count), dtype=torch.int64, device=points.device)
    squared = torch.full((3, count), torch.inf, dtype=torch.float64, device=points.device)
    if count > 0 and len(points) > 0:
        nearest_three[(triton.cdiv(count, _BLOCK),)](
            points.double().contiguous(), queries.t().double().contiguous(), indices, squared, len(points), count,
            BLOCK=_BLOCK, enable_fp_fusion=False,
        )  # fmt: skip
    return indices.t().contiguous(), squared.t().contiguous()


@triton.jit
def nearest_three(points, queries, indices, squared, n, count, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """``points`` (n, 3) and ``queries`` (3, count) in float64; ``indices`` and ``squared`` (3, count)."""
    rows = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = rows < count
    x = tl.load(queries + rows, mask=there, other=0.0)
    y = tl.load(queries + count + rows, mask=there, other=0.0)
    z = tl.load(queries + 2 * count + rows, mask=there, other=0.0)
    a0 = tl.full((BLOCK,), float("inf"), tl.float64)
    a1, a2 = a0, a0
    n0 = tl.zeros((BLOCK,), tl.int32)
    n1, n2 = n0, n0
    for p in range(n):
        dx = tl.load(points + 3 * p) - x
        dy = tl.load(points + 3 * p + 1) - y
        dz = tl.load(points + 3 * p + 2) - z
        d = dx * dx + dy * dy + dz * dz
        # Of equally near points the first one counts as nearer.
        first, second, third = d < a0, d < a1, d < a2
        a2 = tl.where(second, a1, tl.where(third, d, a2))
        n2 = tl.where(second, n1, tl.where(third, p, n2))
        a1 = tl.where(first, a0, tl.where(second, d, a1))
        n1 = tl.where(first, n0, tl.where(second, p, n1))
        a0 = tl.where(first, d, a0)
        n0 = tl.where(first, p, n0)
    tl.store(squared + rows, a0, mask=there)
    tl.store(squared + count + rows, a1, mask=there)
    tl.store(squared + 2 * count + rows, a2, mask=there)
    tl.store(indices + rows, n0, mask=there)
    tl.store(indices + count + rows, n1, mask=there)
    tl.store(indices + 2 * count + rows, n2, mask=there)
