"""Farthest point sampling as one kernel: no launch for each point drawn."""

from __future__ import annotations

import torch
import triton
import triton.language as tl

_BLOCK = 4096
"""Points that the program looks at in one go."""
_WARPS = 32
"""As many as a program can have: there is one program for the whole cloud."""


def farthest_points_on_gpu(points: torch.Tensor, count: int, start: int = 0) -> torch.Tensor:
    """``ops.farthest_points.farthest_points_in_torch``: indices (count,) of points (N, 3), 0 < count <= N -> int64."""
    coordinates = points.float().t().contiguous()
    nearest = torch.full((len(points),), torch.inf, dtype=torch.float32, device=points.device)
    drawn = torch.empty(count, dtype=torch.int64, device=points.device)
    draw[(1,)](
        coordinates, nearest, drawn, len(points), count, start, BLOCK=_BLOCK, num_warps=_WARPS, enable_fp_fusion=False
    )
    return drawn


@triton.jit
def draw(coordinates, nearest, drawn, n, count, start, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """One program. ``coordinates`` (3, n) and ``nearest`` (n,), each point's distance to those drawn, in float32."""
    lanes = tl.arange(0, BLOCK)
    last = start
    tl.store(drawn, last)
    for i in range(1, count):
        x = tl.load(coordinates + last)
        y = tl.load(coordinates + n + last)
        z = tl.load(coordinates + 2 * n + last)
        top = tl.full((BLOCK,), -1.0, tl.float32)
        where = tl.zeros((BLOCK,), tl.int32)
        for first in range(0, n, BLOCK):
            rows = first + lanes
            there = rows < n
            dx = tl.load(coordinates + rows, mask=there, other=0.0) - x
            dy = tl.load(coordinates + n + rows, mask=there, other=0.0) - y
            dz = tl.load(coordinates + 2 * n + rows, mask=there, other=0.0) - z
            # Each lane reads what it wrote itself: there is nothing to wait for.
            before = tl.load(nearest + rows, mask=there, other=-2.0)
            now = tl.minimum(before, dx * dx + dy * dy + dz * dz)
            tl.store(nearest + rows, now, mask=there)
            farther = now > top
            top = tl.where(farther, now, top)
            where = tl.where(farther, rows, where)
        # Of equally far points the first one.
        last = tl.min(tl.where(top == tl.max(top, 0), where, n), 0)
        tl.store(drawn + i, last)
