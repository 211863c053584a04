"""Box query: the points of a cloud inside turned boxes, such as the closing areas of grasps; ragged, at most K each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from regnet_core.ops.ball_query import point_grid
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels
from regnet_core.ops.neighbourhoods import Neighbourhoods, collect, from_mask, keep_first
from regnet_core.ops.voxel_grid import VoxelGrid, cells_of_box

_CELL = 0.02
"""Edge length of the cells of a grid made for one query [m]."""
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


def box_query(points: torch.Tensor, boxes: Boxes, most: int, grid: VoxelGrid | None = None) -> Neighbourhoods:
    """The points of one cloud inside each box, its surface left out; of more than K, the first K.

    Args:
        points: (N, 3).
        boxes: G.
        most: K.
        grid: of the points, from ``point_grid``, where there is one already.
    """
    points, boxes = points.detach(), Boxes(*(value.detach() for value in boxes))
    if points.device.type == "cpu":
        return _queried_on_cpu(points, boxes, most, grid)
    if has_kernels(points):
        from regnet_core.ops.gpu.queries import box_query_on_gpu

        return box_query_on_gpu(points, boxes.rotation, boxes.middle(), boxes.half(), most)
    return box_query_in_torch(points, boxes, most)


def _queried_on_cpu(points: torch.Tensor, boxes: Boxes, most: int, grid: VoxelGrid | None) -> Neighbourhoods:
    cells = grid or point_grid(points, _CELL)
    assert cells is not None  # the points are on a CPU
    pose, c, low, high = (value.numpy().astype(np.float64) for value in boxes)

    def search(start, stop, counts, found):  # type: ignore[no-untyped-def]
        _search(
            pose, c, low, high, cells.points, cells.order, cells.start, cells.origin, cells.shape, cells.cell,
            start, stop, counts, found,
        )  # fmt: skip

    return collect(search, len(c), most)


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
def _search(pose, c, low, high, points, order, starts, origin, shape, cell, begin, end, counts, found):  # type: ignore[no-untyped-def]
    near = np.empty(len(points) + 1, np.int32)
    middle, half = np.empty(3), np.empty(3)
    for g in range(begin, end):
        r = pose[g]
        for a in range(3):
            half[a] = (high[g, a] - low[g, a]) / 2
            middle[a] = c[g, a]
        for a in range(3):
            along = (high[g, a] + low[g, a]) / 2
            for b in range(3):
                middle[b] += r[b, a] * along
        i0, i1, j0, j1, k0, k1 = cells_of_box(r, middle, half, origin, cell, shape)
        if k1 < k0:
            continue
        xx, xy, xz = r[0, 0], r[1, 0], r[2, 0]
        yx, yy, yz = r[0, 1], r[1, 1], r[2, 1]
        zx, zy, zz = r[0, 2], r[1, 2], r[2, 2]
        mx, my, mz = middle
        hx, hy, hz = half
        n = 0
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                row = (i * shape[1] + j) * shape[2]
                for p in range(starts[row + k0], starts[row + k1 + 1]):
                    dx, dy, dz = points[p, 0] - mx, points[p, 1] - my, points[p, 2] - mz
                    # Each is written down, and stays if it is inside: branches would often be guessed wrong.
                    near[n] = order[p]
                    n += (
                        (abs(xx * dx + xy * dy + xz * dz) < hx)
                        & (abs(yx * dx + yy * dy + yz * dz) < hy)
                        & (abs(zx * dx + zy * dy + zz * dz) < hz)
                    )
        keep_first(near, n, g, counts, found)
