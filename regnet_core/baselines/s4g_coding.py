"""S4G's grasps: between poses and what the network predicts, expected scores, and which grasps are the best around."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from regnet_core.nn.anchors import Pose

_NO_DIRECTION = 1e-6
"""Vectors shorter than this have no direction; another is taken."""


def encode_rotation(rotation: Tensor) -> Tensor:
    """(..., 6) of rotations (..., 3, 3): their first two columns, one after the other."""
    return torch.cat([rotation[..., :, 0], rotation[..., :, 1]], dim=-1)


def decode_rotation(code: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of any codes (..., 6), by Gram and Schmidt; of a rotation's code, the rotation."""
    x = _direction(code[..., :3], code.new_tensor([0.0, 0.0, -1.0]))
    y = code[..., 3:] - (code[..., 3:] * x).sum(-1, keepdim=True) * x
    y = _direction(y, _perpendicular(x.detach()))
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def encode_offset(points: Tensor, translation: Tensor, unit: float) -> Tensor:
    """(..., 3): where grasp centres (..., 3) are from points (..., 3), in units [m]."""
    return (translation - points) / unit


def decode(points: Tensor, rotation: Tensor, offset: Tensor, unit: float) -> Pose:
    """The grasps (N) predicted at points (N, 3) [m], from codes (N, 6) and offsets (N, 3)."""
    return Pose(decode_rotation(rotation), points + unit * offset)


def score_class(score: Tensor, classes: int) -> Tensor:
    """(...) int64: the class of scores (...) in [0, 1], of equally wide ones; a bound belongs to the class below."""
    return (torch.ceil(score * classes).long() - 1).clamp(0, classes - 1)


def expected_score(logits: Tensor) -> Tensor:
    """(N,) in [0, 1] of logits (N, classes): the mean of the classes' values, evenly spaced from 0 to 1."""
    values = torch.linspace(0.0, 1.0, logits.shape[1], device=logits.device)
    return logits.float().softmax(dim=1) @ values


def symmetric_error(predicted: Tensor, wanted: Tensor) -> Tensor:
    """(...) mean squared difference of rotations (..., 3, 3), to the nearer of the jaw's two forms."""
    turned = wanted * wanted.new_tensor([1.0, -1.0, -1.0])
    errors = torch.stack([(predicted - form).square().mean(dim=(-2, -1)) for form in (wanted, turned)])
    return errors.amin(dim=0)


def best_around(pose: Pose, score: Tensor, distance: float, angle: float) -> Tensor:
    """Non-maximum suppression: rows of the grasps (G) that have no better one near them that stays, best first.

    Args:
        pose: of the grasps.
        score: (G,).
        distance: centres nearer than this may be of one grasp [m].
        angle: approaches that differ by less than this, and closing axes, may be of one grasp [rad].
    """
    order = score.argsort(descending=True, stable=True)
    centre = pose.translation[order].double()
    approach, closing = (pose.rotation[order][..., axis].double() for axis in (0, 1))
    left = torch.ones(len(order), dtype=torch.bool, device=score.device)
    kept, least = [], math.cos(angle)
    for row in range(len(order)):
        if not left[row]:
            continue
        kept.append(row)
        near = (centre - centre[row]).norm(dim=1) < distance
        near &= (approach @ approach[row] > least) & ((closing @ closing[row]).abs() > least)
        left &= ~near
    return order[torch.tensor(kept, dtype=torch.int64, device=order.device)]


def _direction(vector: Tensor, fallback: Tensor) -> Tensor:
    """Unit vectors along vectors (..., 3); the fallback, without a gradient, for those that are too short."""
    usable = torch.linalg.vector_norm(vector.detach(), dim=-1, keepdim=True) > _NO_DIRECTION
    safe = torch.where(usable, vector, fallback.expand_as(vector))
    return safe / torch.linalg.vector_norm(safe, dim=-1, keepdim=True)


def _perpendicular(x: Tensor) -> Tensor:
    """Some unit vector perpendicular to each of (..., 3)."""
    least = torch.nn.functional.one_hot(x.abs().argmin(dim=-1), 3).to(x.dtype)
    side = torch.linalg.cross(x, least)
    return side / torch.linalg.vector_norm(side, dim=-1, keepdim=True)
