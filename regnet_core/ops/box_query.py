"""Box query: the points of a cloud inside turned boxes, such as the closing areas of grasps; ragged, at most K each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from regnet_core.ops.buckets import GROUP, SIZE, Buckets, in_buckets
from regnet_core.ops.compiled import compiled, inlined
from regnet_core.ops.gpu import has_kernels
from regnet_core.ops.neighbourhoods import Neighbourhoods, collect, from_mask, keep_first

_CHUNK = 1 << 23
"""Pairs of a box and a point that the search in torch looks at in one go."""


class Boxes(NamedTuple):
    """G turned boxes."""

    rotation: torch.Tensor
    """(G, 3, 3): their frames, axes as columns."""
    translation: torch.Tensor
    """(G, 3): the origins of these frames [m]."""
    lower: torch.Tensor
    """(G, 3): lower corners in these frames [m]."""
    upper: torch.Tensor
    """(G, 3): upper corners [m]."""

    def middle(self) -> torch.Tensor:
        """(G, 3) float64: where their middles are [m]."""
        along = (self.lower.double() + self.upper.double()) / 2
        return self.translation.double() + (self.rotation.double() * along[:, None, :]).sum(dim=2)

    def half(self) -> torch.Tensor:
        """(G, 3) float64: half the lengths of their edges [m]."""
        return (self.upper.double() - self.lower.double()) / 2

    def take(self, some: slice) -> Boxes:
        """Some of them."""
        return Boxes(*(value[some] for value in self))


def box_query(points: torch.Tensor, boxes: Boxes, most: int, buckets: Buckets | None = None) -> Neighbourhoods:
    """The points of one cloud inside each box, its surface left out; of more than K, the first K.

    Args:
        points: (N, 3).
        boxes: G.
        most: K.
        buckets: of the points, from ``point_buckets``, where there are some already.
    """
    points, boxes = points.detach(), Boxes(*(value.detach() for value in boxes))
    if points.device.type == "cpu":
        return _queried_on_cpu(points, boxes, most, buckets)
    if has_kernels(points):
        from regnet_core.ops.gpu.queries import box_query_on_gpu

        return box_query_on_gpu(points, boxes.rotation, boxes.middle(), boxes.half(), most)
    return box_query_in_torch(points, boxes, most)


def _queried_on_cpu(points: torch.Tensor, boxes: Boxes, most: int, buckets: Buckets | None) -> Neighbourhoods:
    given = buckets or in_buckets(points.float().numpy())
    axes = boxes.rotation.transpose(1, 2).double().contiguous().numpy()
    middle, half = boxes.middle().numpy(), boxes.half().numpy()
    return collect(
        lambda start, stop, counts, found: _search(axes, middle, half, given, start, stop, counts, found),
        len(middle),
        most,
    )


def box_query_in_torch(points: torch.Tensor, boxes: Boxes, most: int) -> Neighbourhoods:
    """The same on any device: every box is compared with every point."""
    step = max(1, _CHUNK // max(1, len(points)))
    masks = [torch.zeros((0, len(points)), dtype=torch.bool, device=points.device)]
    for g in range(0, len(boxes.translation), step):
        some = boxes.take(slice(g, g + step))
        local = (points[None].double() - some.translation[:, None].double()) @ some.rotation.double()  # (g, N, 3)
        masks.append(((local > some.lower[:, None]) & (local < some.upper[:, None])).all(dim=-1))
    return from_mask(torch.cat(masks), most)


@inlined
def _apart(lower, upper, b, x, y, z, hx, hy, hz, middle):  # type: ignore[no-untyped-def]
    """Whether one of a turned box's sides keeps box ``b``, along the world's axes, off it; for some that do not meet
    none does."""
    cx, cy, cz = (lower[b, 0] + upper[b, 0]) / 2, (lower[b, 1] + upper[b, 1]) / 2, (lower[b, 2] + upper[b, 2]) / 2
    ex, ey, ez = upper[b, 0] - cx, upper[b, 1] - cy, upper[b, 2] - cz
    dx, dy, dz = cx - middle[0], cy - middle[1], cz - middle[2]
    return (
        (abs(x[0] * dx + x[1] * dy + x[2] * dz) > hx + abs(x[0]) * ex + abs(x[1]) * ey + abs(x[2]) * ez)
        | (abs(y[0] * dx + y[1] * dy + y[2] * dz) > hy + abs(y[0]) * ex + abs(y[1]) * ey + abs(y[2]) * ez)
        | (abs(z[0] * dx + z[1] * dy + z[2] * dz) > hz + abs(z[0]) * ex + abs(z[1]) * ey + abs(z[2]) * ez)
    )


@compiled
def _search(axes, middle, half, points, begin, end, counts, found):  # type: ignore[no-untyped-def]
    near, outside = np.empty(points.count + SIZE, np.int32), np.empty(SIZE, np.int32)
    for g in range(begin, end):
        # float32 is sure of all points but those next to the surface.
        tolerance = 1e-6 * (np.abs(middle[g]).max() + half[g].sum())
        m0, m1, m2 = np.float32(middle[g, 0]), np.float32(middle[g, 1]), np.float32(middle[g, 2])
        hx, hy, hz = half[g, 0], half[g, 1], half[g, 2]
        x, y, z = axes[g, 0].astype(np.float32), axes[g, 1].astype(np.float32), axes[g, 2].astype(np.float32)
        x0, x1, x2, y0, y1, y2, z0, z1, z2 = x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]
        ix, iy, iz = np.float32(hx - tolerance), np.float32(hy - tolerance), np.float32(hz - tolerance)
        px, py, pz = np.float32(hx + tolerance), np.float32(hy + tolerance), np.float32(hz + tolerance)
        n = 0
        for c in range(len(points.group_lower)):
            if _apart(points.group_lower, points.group_upper, c, x, y, z, px, py, pz, (m0, m1, m2)):
                continue
            for b in range(c * GROUP, min((c + 1) * GROUP, len(points.rows))):
                if _apart(points.lower, points.upper, b, x, y, z, px, py, pz, (m0, m1, m2)):
                    continue
                bx, by, bz, rows = points.points[b, 0], points.points[b, 1], points.points[b, 2], points.rows[b]
                unsure = np.int32(0)
                for i in range(SIZE):
                    dx, dy, dz = bx[i] - m0, by[i] - m1, bz[i] - m2
                    u = abs(x0 * dx + x1 * dy + x2 * dz)
                    v = abs(y0 * dx + y1 * dy + y2 * dz)
                    w = abs(z0 * dx + z1 * dy + z2 * dz)
                    no = np.int32((u >= px) | (v >= py) | (w >= pz))
                    outside[i] = no
                    unsure += np.int32((u > ix) | (v > iy) | (w > iz)) - no
                if unsure:
                    for i in range(SIZE):
                        dx, dy, dz = bx[i] - middle[g, 0], by[i] - middle[g, 1], bz[i] - middle[g, 2]
                        outside[i] = not (
                            (abs(axes[g, 0, 0] * dx + axes[g, 0, 1] * dy + axes[g, 0, 2] * dz) < hx)
                            & (abs(axes[g, 1, 0] * dx + axes[g, 1, 1] * dy + axes[g, 1, 2] * dz) < hy)
                            & (abs(axes[g, 2, 0] * dx + axes[g, 2, 1] * dy + axes[g, 2, 2] * dz) < hz)
                        )
                for i in range(min(SIZE, points.count - b * SIZE)):
                    # Each is written down, and stays if it is inside: branches would often be guessed wrong.
                    near[n] = rows[i]
                    n += 1 - outside[i]
        keep_first(near, n, g, counts, found)
