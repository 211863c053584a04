"""Box query: the points of a cloud inside turned boxes, such as the closing areas of grasps; ragged, at most K each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from regnet_core.ops.buckets import BOX_BYTES, BUCKET_BYTES, GROUP, Buckets, in_buckets, own_bits
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels
from regnet_core.ops.lanes import boxes_at_turned_box, in_turned_box, lowest_bit
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
    return collect(_search, len(middle), most, 1500, axes, middle, half, given)


def box_query_in_torch(points: torch.Tensor, boxes: Boxes, most: int) -> Neighbourhoods:
    """The same on any device: every box is compared with every point."""
    step = max(1, _CHUNK // max(1, len(points)))
    masks = [torch.zeros((0, len(points)), dtype=torch.bool, device=points.device)]
    for g in range(0, len(boxes.translation), step):
        some = boxes.take(slice(g, g + step))
        local = (points[None].double() - some.translation[:, None].double()) @ some.rotation.double()  # (g, N, 3)
        masks.append(((local > some.lower[:, None]) & (local < some.upper[:, None])).all(dim=-1))
    return from_mask(torch.cat(masks), most)


@compiled
def _search(begin, end, axes, middle, half, points, counts, found):  # type: ignore[no-untyped-def]
    near, at = np.empty(points.number, np.int32), points.points.ctypes.data
    groups, boxes = points.groups.ctypes.data, points.boxes.ctypes.data
    for q in range(begin, end):
        # float32 is sure of all points but those next to the surface.
        tolerance = 1e-6 * (np.abs(middle[q]).max() + half[q].sum())
        x, y, z = axes[q, 0].astype(np.float32), axes[q, 1].astype(np.float32), axes[q, 2].astype(np.float32)
        a0, a1, a2, b0, b1, b2, c0, c1, c2 = x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]
        m0, m1, m2 = np.float32(middle[q, 0]), np.float32(middle[q, 1]), np.float32(middle[q, 2])
        hx, hy, hz = half[q, 0], half[q, 1], half[q, 2]
        u, v, w = np.float32(hx + tolerance), np.float32(hy + tolerance), np.float32(hz + tolerance)
        iu, iv, iw = np.float32(hx - tolerance), np.float32(hy - tolerance), np.float32(hz - tolerance)
        n = 0
        for s in range(len(points.groups)):
            some_groups = boxes_at_turned_box(
                groups + s * BOX_BYTES, a0, a1, a2, b0, b1, b2, c0, c1, c2, m0, m1, m2, u, v, w
            )
            while some_groups != 0:
                g = s * GROUP + lowest_bit(some_groups)
                some_groups &= some_groups - 1
                some_buckets = boxes_at_turned_box(
                    boxes + g * BOX_BYTES, a0, a1, a2, b0, b1, b2, c0, c1, c2, m0, m1, m2, u, v, w
                )
                while some_buckets != 0:
                    b = g * GROUP + lowest_bit(some_buckets)
                    some_buckets &= some_buckets - 1
                    place = at + b * BUCKET_BYTES
                    some = in_turned_box(place, a0, a1, a2, b0, b1, b2, c0, c1, c2, m0, m1, m2, u, v, w)
                    some &= own_bits(points, b)
                    sure = in_turned_box(place, a0, a1, a2, b0, b1, b2, c0, c1, c2, m0, m1, m2, iu, iv, iw)
                    while some != 0:
                        i = lowest_bit(some)
                        some &= some - 1
                        near[n] = points.rows[b, i]
                        if (sure >> i) & 1:
                            n += 1
                        else:
                            n += int(_is_inside(axes[q], middle[q], half[q], points.points[b], i))
        keep_first(near, n, q, counts, found)


@compiled
def _is_inside(axes, middle, half, points, i):  # type: ignore[no-untyped-def]
    inside = True
    for a in range(3):
        along = 0.0
        for k in range(3):
            along += axes[a, k] * (points[k, i] - middle[k])
        inside &= abs(along) < half[a]
    return inside
