"""Ball and box queries: a program for each centre goes through the points in their order until it has enough.

Distances are computed in float64 and without fused operations, as everywhere, so that all devices find the same points.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl

from regnet_core.ops.neighbourhoods import Neighbourhoods

_BLOCK = 1024
"""Points that a program looks at in one go."""


def ball_query_on_gpu(points: torch.Tensor, centres: torch.Tensor, radius: float, most: int) -> Neighbourhoods:
    """``ops.ball_query.ball_query``: the first ``most`` of the points (N, 3) around each centre (C, 3)."""
    squared = torch.tensor([radius * radius], dtype=torch.float64, device=points.device)
    found, counts = _room(len(centres), most, points.device)
    if len(centres) > 0:
        first_in_ball[(len(centres),)](
            _coordinates(points), centres.double().contiguous(), squared, found, counts, len(points), most,
            BLOCK=_BLOCK, enable_fp_fusion=False,
        )  # fmt: skip
    return _ragged(found, counts)


def box_query_on_gpu(
    points: torch.Tensor, rotation: torch.Tensor, middle: torch.Tensor, half: torch.Tensor, most: int
) -> Neighbourhoods:
    """``ops.box_query.box_query``, for boxes of which the middles and half the edges are given.

    Args:
        points: (N, 3).
        rotation: (G, 3, 3), axes as columns.
        middle: (G, 3).
        half: (G, 3).
        most: K.
    """
    axes = rotation.transpose(1, 2).reshape(-1, 9)
    boxes = torch.cat([axes.double(), middle.double(), half.double()], dim=1).contiguous()
    found, counts = _room(len(boxes), most, points.device)
    if len(boxes) > 0:
        first_in_box[(len(boxes),)](
            _coordinates(points), boxes, found, counts, len(points), most, BLOCK=_BLOCK, enable_fp_fusion=False
        )
    return _ragged(found, counts)


def _coordinates(points: torch.Tensor) -> torch.Tensor:
    """(3, N) float64: each coordinate of all points together, as programs read them."""
    return points.t().double().contiguous()


def _room(centres: int, most: int, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    found = torch.empty((centres, most), dtype=torch.int32, device=device)
    return found, torch.zeros(centres, dtype=torch.int32, device=device)


def _ragged(found: torch.Tensor, counts: torch.Tensor) -> Neighbourhoods:
    offsets = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, 0, out=offsets[1:])
    there = torch.arange(found.shape[1], device=found.device) < counts[:, None]
    return Neighbourhoods(found[there].long(), offsets)


@triton.jit
def first_in_ball(coordinates, centres, squared, found, counts, n, most, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """A program for each centre; ``coordinates`` (3, n), ``centres`` (C, 3) and ``squared`` (1,) in float64."""
    centre = tl.program_id(0)
    x = tl.load(centres + 3 * centre)
    y = tl.load(centres + 3 * centre + 1)
    z = tl.load(centres + 3 * centre + 2)
    limit = tl.load(squared)
    lanes = tl.arange(0, BLOCK)
    kept, first = 0, 0
    while (first < n) & (kept < most):
        rows = first + lanes
        there = rows < n
        dx = tl.load(coordinates + rows, mask=there, other=0.0) - x
        dy = tl.load(coordinates + n + rows, mask=there, other=0.0) - y
        dz = tl.load(coordinates + 2 * n + rows, mask=there, other=0.0) - z
        inside = (there & (dx * dx + dy * dy + dz * dz <= limit)).to(tl.int32)
        place = kept + tl.cumsum(inside, 0) - 1
        tl.store(found + centre * most + place, rows, mask=(inside > 0) & (place < most))
        kept += tl.sum(inside, 0)
        first += BLOCK
    tl.store(counts + centre, tl.minimum(kept, most))


@triton.jit
def first_in_box(coordinates, boxes, found, counts, n, most, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """A program for each box; ``boxes`` (G, 15): three axes, middle and half the edges, in float64."""
    box = tl.program_id(0)
    at = boxes + 15 * box
    xx, xy, xz = tl.load(at), tl.load(at + 1), tl.load(at + 2)
    yx, yy, yz = tl.load(at + 3), tl.load(at + 4), tl.load(at + 5)
    zx, zy, zz = tl.load(at + 6), tl.load(at + 7), tl.load(at + 8)
    mx, my, mz = tl.load(at + 9), tl.load(at + 10), tl.load(at + 11)
    hx, hy, hz = tl.load(at + 12), tl.load(at + 13), tl.load(at + 14)
    lanes = tl.arange(0, BLOCK)
    kept, first = 0, 0
    while (first < n) & (kept < most):
        rows = first + lanes
        there = rows < n
        dx = tl.load(coordinates + rows, mask=there, other=0.0) - mx
        dy = tl.load(coordinates + n + rows, mask=there, other=0.0) - my
        dz = tl.load(coordinates + 2 * n + rows, mask=there, other=0.0) - mz
        inside = there & (tl.abs(xx * dx + xy * dy + xz * dz) < hx)
        inside = inside & (tl.abs(yx * dx + yy * dy + yz * dz) < hy)
        inside = (inside & (tl.abs(zx * dx + zy * dy + zz * dz) < hz)).to(tl.int32)
        place = kept + tl.cumsum(inside, 0) - 1
        tl.store(found + box * most + place, rows, mask=(inside > 0) & (place < most))
        kept += tl.sum(inside, 0)
        first += BLOCK
    tl.store(counts + box, tl.minimum(kept, most))
