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
) -> torch.Tensor:
    """Where E points are in the frames of G grasps, R^T (x - t), and what R^T S R is of their shapes; no gradients.

    Args:
        points: (N, 3) float32 [m].
        shapes: (N, 3, 3) float32, symmetric; None where there are none.
        rotation: (G, 3, 3) float32, axes as columns.
        translation: (G, 3) float32 [m].
        near: of the grasps, as rows of the points.

    Returns:
        (E, 3) float32 [m], or (E, 9) with the unique entries of the shapes.
    """
    points, rotation, translation = points.detach(), rotation.detach(), translation.detach()
    if points.device.type != "cpu":
        return seen_from_grasps_in_torch(points, shapes, rotation, translation, near)
    seen = torch.empty((len(near.indices), 3 if shapes is None else 3 + SHAPE_CHANNELS))
    surface = np.zeros((0, 3, 3), np.float32) if shapes is None else shapes.detach().contiguous().numpy()
    where, pose, origin = points.contiguous().numpy(), rotation.contiguous().numpy(), translation.contiguous().numpy()
    rows, bounds, out = near.indices.numpy(), near.offsets.numpy(), seen.numpy()

    def run(start: int, stop: int) -> None:
        _look(where, surface, shapes is not None, pose, origin, rows, bounds, start, stop, out)

    for_each_range(run, len(rotation), least=32)
    return seen


def seen_from_grasps_in_torch(
    points: torch.Tensor,
    shapes: torch.Tensor | None,
    rotation: torch.Tensor,
    translation: torch.Tensor,
    near: Neighbourhoods,
) -> torch.Tensor:
    """The same on any device."""
    grasp = near.centres()
    frames = rotation.index_select(0, grasp)
    offset = points.index_select(0, near.indices) - translation.index_select(0, grasp)
    # Not a matrix product, which autocast would compute in bfloat16.
    local = (frames * offset[:, :, None]).sum(dim=1)
    if shapes is None:
        return local
    return torch.cat([local, unique_entries(turned(shapes.index_select(0, near.indices), frames))], dim=1)


@compiled
def _look(points, shapes, with_shapes, rotation, translation, indices, offsets, begin, end, seen):  # type: ignore[no-untyped-def]
    half = np.empty((3, 3), np.float32)
    for g in range(begin, end):
        r = rotation[g]
        for e in range(offsets[g], offsets[g + 1]):
            row = indices[e]
            x, y, z = (
                points[row, 0] - translation[g, 0],
                points[row, 1] - translation[g, 1],
                points[row, 2] - translation[g, 2],
            )
            for a in range(3):
                seen[e, a] = r[0, a] * x + r[1, a] * y + r[2, a] * z
            if not with_shapes:
                continue
            s = shapes[row]
            for i in range(3):
                for a in range(3):
                    half[i, a] = s[i, 0] * r[0, a] + s[i, 1] * r[1, a] + s[i, 2] * r[2, a]
            for a in range(3):
                seen[e, 3 + a] = r[0, a] * half[0, a] + r[1, a] * half[1, a] + r[2, a] * half[2, a]
            seen[e, 6] = r[0, 0] * half[0, 1] + r[1, 0] * half[1, 1] + r[2, 0] * half[2, 1]
            seen[e, 7] = r[0, 0] * half[0, 2] + r[1, 0] * half[1, 2] + r[2, 0] * half[2, 2]
            seen[e, 8] = r[0, 1] * half[0, 2] + r[1, 1] * half[1, 2] + r[2, 1] * half[2, 2]
