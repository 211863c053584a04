"""Covariances of the points around every point: programs compare theirs with all others, and keep no table of pairs."""

from __future__ import annotations

import torch
import triton
import triton.language as tl

_QUERIES, _POINTS = 32, 64
"""Points of a program, and how many others it compares them with in one go."""


def covariance_on_gpu(points: torch.Tensor, radius: float) -> torch.Tensor:
    """``ops.local_shape.covariance_in_torch``: (N, 3, 3) [m2] of the points (N, 3) within ``radius`` [m] of each."""
    n = len(points)
    entries = torch.zeros((6, n), dtype=torch.float32, device=points.device)
    if n > 0:
        moments[(triton.cdiv(n, _QUERIES),)](
            points.float().t().contiguous(), entries, n, float(radius * radius),
            QUERIES=_QUERIES, POINTS=_POINTS, enable_fp_fusion=False,
        )  # fmt: skip
    xx, yy, zz, xy, xz, yz = entries.double()
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=1).reshape(-1, 3, 3)


@triton.jit
def moments(coordinates, entries, n, squared, QUERIES: tl.constexpr, POINTS: tl.constexpr):  # type: ignore[no-untyped-def]
    """``coordinates`` (3, n) and ``entries`` (6, n), xx, yy, zz, xy, xz, yz, in float32."""
    rows = tl.program_id(0) * QUERIES + tl.arange(0, QUERIES)
    there = rows < n
    x = tl.load(coordinates + rows, mask=there, other=0.0)[:, None]
    y = tl.load(coordinates + n + rows, mask=there, other=0.0)[:, None]
    z = tl.load(coordinates + 2 * n + rows, mask=there, other=0.0)[:, None]
    count = tl.zeros((QUERIES,), tl.float32)
    sx, sy, sz = count, count, count
    sxx, syy, szz, sxy, sxz, syz = count, count, count, count, count, count
    for first in range(0, n, POINTS):
        others = first + tl.arange(0, POINTS)
        real = others < n
        # As seen from the point itself: small numbers, whose squares keep their digits.
        dx = tl.load(coordinates + others, mask=real, other=0.0)[None, :] - x
        dy = tl.load(coordinates + n + others, mask=real, other=0.0)[None, :] - y
        dz = tl.load(coordinates + 2 * n + others, mask=real, other=0.0)[None, :] - z
        near = real[None, :] & (dx * dx + dy * dy + dz * dz <= squared)
        dx = tl.where(near, dx, 0.0)
        dy = tl.where(near, dy, 0.0)
        dz = tl.where(near, dz, 0.0)
        count += tl.sum(near.to(tl.float32), 1)
        sx += tl.sum(dx, 1)
        sy += tl.sum(dy, 1)
        sz += tl.sum(dz, 1)
        sxx += tl.sum(dx * dx, 1)
        syy += tl.sum(dy * dy, 1)
        szz += tl.sum(dz * dz, 1)
        sxy += tl.sum(dx * dy, 1)
        sxz += tl.sum(dx * dz, 1)
        syz += tl.sum(dy * dz, 1)
    share = 1.0 / tl.maximum(count, 1.0)
    sx, sy, sz = sx * share, sy * share, sz * share
    tl.store(entries + rows, sxx * share - sx * sx, mask=there)
    tl.store(entries + n + rows, syy * share - sy * sy, mask=there)
    tl.store(entries + 2 * n + rows, szz * share - sz * sz, mask=there)
    tl.store(entries + 3 * n + rows, sxy * share - sx * sy, mask=there)
    tl.store(entries + 4 * n + rows, sxz * share - sx * sz, mask=there)
    tl.store(entries + 5 * n + rows, syz * share - sy * sz, mask=there)
