"""Points, and the shapes of the surface around them, as seen in the frames of the grasps that they are near."""

from __future__ import annotations

import numpy as np
import torch

from regnet_core.ops.compiled import compiled
from regnet_core.ops.local_shape import SHAPE_CHANNELS, turned, unique_entries
from regnet_core.ops.neighbourhoods import Neighbourhoods
from regnet_core.ops.parallel import for_each_range


def seen_from_grasps(
    points: torch.Tensor,
    shapes: torch.Tensor | None,
    rotation: torch.Tensor,
    translation: torch.Tensor,
    near: Neighbourhoods,
    unit: float = 1.0,
    carried: torch.Tensor | None = None,
) -> torch.Tensor:
    """Where E points are in the frames of G grasps, R^T (x - t), and what R^T S R is of their shapes; no gradients.

    Args:
        points: (N, 3) float32 [m].
        shapes: (N, 3, 3) float32, symmetric; None where there are none.
        rotation: (G, 3, 3) float32, axes as columns.
        translation: (G, 3) float32 [m].
        near: of the grasps, as rows of the points.
        unit: of the positions [m].
        carried: (G, K) float32, numbers of each grasp that all its points get; None for none.

    Returns:
        (E, 3 + K) float32: positions in that unit, and the numbers; or (E, 3 + K + 6), with the unique entries of the
        shapes.
    """
    points, rotation, translation = points.detach(), rotation.detach(), translation.detach()
    if carried is None:
        carried = points.new_zeros((len(rotation), 0))
    if points.device.type != "cpu":
        return seen_from_grasps_in_torch(points, shapes, rotation, translation, near, unit, carried)
    channels = 3 + carried.shape[1] + (0 if shapes is None else SHAPE_CHANNELS)
    seen = torch.empty((len(near.indices), channels))
    surface = np.zeros((0, 3, 3), np.float32) if shapes is None else shapes.detach().contiguous().numpy()
    where, pose, origin = points.contiguous().numpy(), rotation.contiguous().numpy(), translation.contiguous().numpy()
    rows, bounds, out = near.indices.numpy(), near.offsets.numpy(), seen.numpy()
    numbers, scale = carried.detach().contiguous().numpy(), np.float32(1.0 / unit)

    each = 20 * len(rows) / max(len(rotation), 1)
    for_each_range(
        _look, len(rotation), each, where, surface, shapes is not None, pose, origin, scale, numbers, rows, bounds, out
    )
    return seen


def seen_from_grasps_in_torch(
    points: torch.Tensor,
    shapes: torch.Tensor | None,
    rotation: torch.Tensor,
    translation: torch.Tensor,
    near: Neighbourhoods,
    unit: float,
    carried: torch.Tensor,
) -> torch.Tensor:
    """The same on any device."""
    grasp = near.centres()
    frames = rotation.index_select(0, grasp)
    offset = points.index_select(0, near.indices) - translation.index_select(0, grasp)
    # Not a matrix product, which autocast would compute in bfloat16.
    local = (frames * offset[:, :, None]).sum(dim=1) / unit
    if shapes is None:
        return torch.cat([local, carried.index_select(0, grasp)], dim=1)
    return torch.cat(
        [local, carried.index_select(0, grasp), unique_entries(turned(shapes.index_select(0, near.indices), frames))],
        dim=1,
    )


@compiled
def _look(begin, end, points, shapes, with_shapes, rotation, translation, scale, carried, indices, offsets, seen):  # type: ignore[no-untyped-def]
    # Numbers instead of small arrays, which would be read again after every write to ``seen``.
    first = 3 + carried.shape[1]
    for g in range(begin, end):
        r00, r01, r02 = rotation[g, 0, 0], rotation[g, 0, 1], rotation[g, 0, 2]
        r10, r11, r12 = rotation[g, 1, 0], rotation[g, 1, 1], rotation[g, 1, 2]
        r20, r21, r22 = rotation[g, 2, 0], rotation[g, 2, 1], rotation[g, 2, 2]
        t0, t1, t2 = translation[g, 0], translation[g, 1], translation[g, 2]
        for e in range(offsets[g], offsets[g + 1]):
            row = indices[e]
            x, y, z = points[row, 0] - t0, points[row, 1] - t1, points[row, 2] - t2
            seen[e, 0] = (r00 * x + r10 * y + r20 * z) * scale
            seen[e, 1] = (r01 * x + r11 * y + r21 * z) * scale
            seen[e, 2] = (r02 * x + r12 * y + r22 * z) * scale
            for k in range(first - 3):
                seen[e, 3 + k] = carried[g, k]
            if not with_shapes:
                continue
            xx, yy, zz = shapes[row, 0, 0], shapes[row, 1, 1], shapes[row, 2, 2]
            xy, xz, yz = shapes[row, 0, 1], shapes[row, 0, 2], shapes[row, 1, 2]
            # The columns of S R.
            a0, a1, a2 = xx * r00 + xy * r10 + xz * r20, xy * r00 + yy * r10 + yz * r20, xz * r00 + yz * r10 + zz * r20
            b0, b1, b2 = xx * r01 + xy * r11 + xz * r21, xy * r01 + yy * r11 + yz * r21, xz * r01 + yz * r11 + zz * r21
            c0, c1, c2 = xx * r02 + xy * r12 + xz * r22, xy * r02 + yy * r12 + yz * r22, xz * r02 + yz * r12 + zz * r22
            seen[e, first] = r00 * a0 + r10 * a1 + r20 * a2
            seen[e, first + 1] = r01 * b0 + r11 * b1 + r21 * b2
            seen[e, first + 2] = r02 * c0 + r12 * c1 + r22 * c2
            seen[e, first + 3] = r00 * b0 + r10 * b1 + r20 * b2
            seen[e, first + 4] = r00 * c0 + r10 * c1 + r20 * c2
            seen[e, first + 5] = r01 * c0 + r11 * c1 + r21 * c2
