"""Grasps of their codes (nn/anchors.py) in one loop, where nobody wants gradients."""

from __future__ import annotations

import numpy as np
import torch

from regnet_core.ops.compiled import compiled

_VERTICAL, _NO_DIRECTION = 1e-9, 1e-6
"""As in nn/anchors.py."""


def is_plain(*values: torch.Tensor) -> bool:
    """Whether the loop takes them: on the CPU, rows of float32 or float64 of the same length, without gradients."""
    first = values[0]
    return all(
        value.device.type == "cpu"
        and len(value) == len(first)
        and value.dtype in (torch.float32, torch.float64)
        and not (value.requires_grad and torch.is_grad_enabled())
        for value in values
    )


def decoded_grasps(
    frame: torch.Tensor,
    reference: torch.Tensor,
    anchor: torch.Tensor,
    theta: tuple[float, float],
    residual: torch.Tensor,
    scale: float,
    depth: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotations (G, 3, 3) and centres (G, 3) of grasps whose codes are written in frames.

    Args:
        frame: (G, 3, 3), axes as columns.
        reference: (G, 3), the places that residuals of place count from [m].
        anchor: (G, 3), closing directions in the frames.
        theta: sin and cos of the anchors' theta.
        residual: (G, 8).
        scale: unit of the residuals of place [m].
        depth: distance of a grasp's reference point from the palm's face [m].
    """
    kind = reference.dtype
    rotation, centre = frame.new_empty((len(frame), 3, 3), dtype=kind), torch.empty_like(reference)
    frames, places, directions, codes = (
        value.detach().to(kind).contiguous().numpy() for value in (frame, reference, anchor, residual)
    )
    _decode(frames, places, directions, codes, np.array(theta), scale, depth, rotation.numpy(), centre.numpy())
    return rotation, centre


@compiled
def _decode(frame, reference, anchor, residual, theta, scale, depth, rotation, centre):  # type: ignore[no-untyped-def]
    own = np.empty((3, 3))
    for g in range(len(frame)):
        code, r = residual[g], own[:, 1]
        for i in range(3):
            r[i] = anchor[g, i] + code[3 + i]
        length = np.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
        if not length > _NO_DIRECTION:
            for i in range(3):
                r[i] = anchor[g, i]
            length = np.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
        for i in range(3):
            r[i] /= length

        sin, cos = theta[0] + code[6], theta[1] + code[7]
        length = np.sqrt(sin * sin + cos * cos)
        if not length > _NO_DIRECTION:
            sin, cos = theta[0], theta[1]
            length = np.sqrt(sin * sin + cos * cos)
        sin, cos = sin / length, cos / length

        x, y = r[1], -r[0]  # the horizontal direction that theta starts from
        length = np.sqrt(x * x + y * y)
        if length > _VERTICAL:
            x, y = x / length, y / length
        else:
            x, y = 1.0, 0.0
        # r x (x, y, 0)
        own[0, 0] = cos * x - sin * r[2] * y
        own[1, 0] = cos * y + sin * r[2] * x
        own[2, 0] = sin * (r[0] * y - r[1] * x)
        own[0, 2] = own[1, 0] * r[2] - own[2, 0] * r[1]
        own[1, 2] = own[2, 0] * r[0] - own[0, 0] * r[2]
        own[2, 2] = own[0, 0] * r[1] - own[1, 0] * r[0]

        for i in range(3):
            moved = 0.0
            for k in range(3):
                total = 0.0
                for j in range(3):
                    total += frame[g, i, j] * own[j, k]
                rotation[g, i, k] = total
                moved += frame[g, i, k] * code[k]
            centre[g, i] = reference[g, i] + scale * moved - depth * rotation[g, i, 0]
