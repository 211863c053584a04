"""Grasp anchors: grasps <-> residuals that a network predicts, for proposals (GRN) and for refined proposals (RN).

Both stages use one code of eight numbers, written in a frame: the world's at a region's point for proposals, the
proposal's own for refined ones. A grasp is expressed there by
- the place of its reference point, the point ``reference_depth`` from the palm's face along the approach, divided by a
  scale. With the default it lies in the middle of the fingers, next to the surface that they close on, wherever the
  hand comes from. The paper's choice, the centre c, swings by up to 6 cm with the approach instead, and an error of the
  orientation moves the fingertips by up to D times that error, twice as far as when the hand turns about its middle;
- its closing direction r minus the anchor. A jaw is symmetric: of the two forms of a grasp, the one with r nearer to
  the anchor is used. This needs no canonical form, which is discontinuous where r crosses its border: a target jumps
  only where r is perpendicular to the anchor, and such anchors do not learn it (matching.py);
- sin and cos of theta (coder.py) minus those of the anchor's theta, pi / 2 (straight down) for proposals and 0 (the
  proposal's own) for refined ones. Unlike the angle itself they do not jump at pi.
Residuals of 0 are thus a hand at the point, closing along the anchor, from straight above; or the proposal itself.
Decoded rotations are orthonormal whatever the residuals. Paper: sections on the Grasp Region and Refine Networks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from regnet_core.checks import as_vector, check_range
from regnet_core.errors import InvalidInputError
from regnet_core.ops.grasp_code import decoded_grasps, is_plain

ANCHORS = ((1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (1.0, -1.0, -1.0), (1.0, -1.0, 1.0))
"""Closing directions of the paper's M = 4 anchors, before they are divided by sqrt(3)."""
RESIDUALS = 8
"""Numbers in the code of a grasp: reference point (3), closing direction (3), sin and cos of theta."""
CENTRE, CLOSING, THETA = slice(0, 3), slice(3, 6), slice(6, 8)
"""Where they are in it."""

_VERTICAL = 1e-9
"""|r x z| below which r counts as vertical, as in coder.py."""
_NO_DIRECTION = 1e-6
"""Length below which a decoded vector has no direction, and the anchor's is taken."""


class Pose(NamedTuple):
    """Grasp frames."""

    rotation: Tensor
    """(..., 3, 3): columns approach X, closing direction Y, Z = X x Y."""
    translation: Tensor
    """(..., 3): grasp centres c [m]."""

    @property
    def approach(self) -> Tensor:
        """(..., 3): X."""
        return self.rotation[..., :, 0]

    @property
    def closing(self) -> Tensor:
        """(..., 3): Y."""
        return self.rotation[..., :, 1]


@dataclass(frozen=True)
class CoderConfig:
    """Units and anchors of the code; part of a trained model. The paper's: reference_depth 0, centre_scale 0.1.

    Raises:
        InvalidInputError: a number is out of range, or an anchor has no direction.
    """

    anchors: tuple[tuple[float, float, float], ...] = ANCHORS
    """Closing directions of any length. A single (1, 0, 0) is the ablation without anchors: its half-space holds one
    form of every grasp."""
    reference_depth: float = 0.03
    """Distance of the reference point from the palm's face along the approach [m]; D / 2 of the paper's gripper."""
    centre_scale: float = 0.02
    """Unit of a proposal's residual of place [m]: the region's radius."""
    refine_scale: float = 0.01
    """Unit of a refined proposal's residual of place [m]: it starts within d1 = 0.015 m."""

    def __post_init__(self) -> None:
        if not self.anchors:
            raise InvalidInputError("anchors must hold at least one closing direction, got none")
        for anchor in self.anchors:
            if not as_vector("an anchor", anchor).any():
                raise InvalidInputError(f"an anchor must be 3 numbers, not all zero, got {anchor!r}")
        check_range("reference_depth", self.reference_depth, 0.0, 0.2, "m")
        check_range("centre_scale", self.centre_scale, 1e-4, 1.0, "m")
        check_range("refine_scale", self.refine_scale, 1e-4, 1.0, "m")


class GraspCoder:
    """Grasps near points <-> (anchor, residuals). ``decode`` inverts ``encode`` up to the jaw's symmetry."""

    def __init__(self, config: CoderConfig | None = None) -> None:
        self.config = config or CoderConfig()

    def anchors(self, like: Tensor) -> Tensor:
        """(A, 3): unit closing directions, of the type and on the device of ``like``."""
        return _normalised(like.new_tensor(self.config.anchors))

    def encode(self, point: Tensor, anchor: Tensor, grasp: Pose) -> Tensor:
        """Residuals (..., 8) of grasps at points (..., 3) [m] and anchors with numbers (...,); shapes broadcast."""
        direction = self.anchors(point)[anchor]
        place = (_reference_point(grasp, self.config.reference_depth) - point) / self.config.centre_scale
        return _encode(place, grasp.rotation, direction, _down(point))

    def decode(self, point: Tensor, anchor: Tensor, residual: Tensor) -> Pose:
        """Grasps (...) of residuals (..., 8) at points (..., 3) [m] and anchors (...,); shapes broadcast."""
        residual, direction = residual.to(point.dtype), self.anchors(point)[anchor]
        if is_plain(point, direction, residual) and point.dim() == direction.dim() == residual.dim() == 2:
            frame, theta, config = torch.eye(3).expand(len(point), 3, 3), (1.0, 0.0), self.config
            scale, depth = config.centre_scale, config.reference_depth
            return Pose(*decoded_grasps(frame, point, direction, theta, residual, scale, depth))
        rotation = _decode_rotation(residual, direction, _down(point))
        reference = point + self.config.centre_scale * residual[..., CENTRE]
        return Pose(rotation, reference - self.config.reference_depth * rotation[..., :, 0])


class RefineCoder:
    """Grasps near proposals <-> residuals in the proposals' own frames; residuals of 0 are the proposals."""

    def __init__(self, config: CoderConfig | None = None) -> None:
        self.config = config or CoderConfig()

    def encode(self, proposal: Pose, grasp: Pose) -> Tensor:
        """Residuals (..., 8) of grasps with respect to proposals; shapes broadcast."""
        depth = self.config.reference_depth
        offset = _reference_point(grasp, depth) - _reference_point(proposal, depth)
        into = proposal.rotation.transpose(-1, -2)
        place = _rotated(into, offset) / self.config.refine_scale
        return _encode(place, _product(into, grasp.rotation), _sideways(offset), _ahead(offset))

    def decode(self, proposal: Pose, residual: Tensor) -> Pose:
        """Refined grasps (...) of proposals and residuals (..., 8); shapes broadcast."""
        residual = residual.to(proposal.translation.dtype)
        if residual.dim() == 2 and proposal.rotation.dim() == 3 and is_plain(residual, *proposal):
            depth, scale = self.config.reference_depth, self.config.refine_scale
            reference, direction = _reference_point(proposal, depth), _sideways(residual).expand(len(residual), 3)
            return Pose(*decoded_grasps(proposal.rotation, reference, direction, (0.0, 1.0), residual, scale, depth))
        own = _decode_rotation(residual, _sideways(residual), _ahead(residual))
        rotation = _product(proposal.rotation, own)
        offset = _rotated(proposal.rotation, residual[..., CENTRE])
        depth = self.config.reference_depth
        reference = _reference_point(proposal, depth) + self.config.refine_scale * offset
        return Pose(rotation, reference - depth * rotation[..., :, 0])


def facing(rotation: Tensor, direction: Tensor) -> Tensor:
    """Of the two forms (X, Y, Z), (X, -Y, -Z) of grasps (..., 3, 3), that whose Y is along direction (..., 3)."""
    back = (rotation[..., :, 1] * direction).sum(-1) < 0.0
    sign = torch.where(back, -1.0, 1.0).to(rotation.dtype)
    return rotation * torch.stack([torch.ones_like(sign), sign, sign], -1)[..., None, :]


def reference_direction(r: Tensor) -> Tensor:
    """X' (..., 3): the horizontal unit vector perpendicular to r (..., 3) that theta starts from; as in coder.py."""
    x = torch.stack([r[..., 1], -r[..., 0], torch.zeros_like(r[..., 0])], -1)
    return _direction(x, r.new_tensor([1.0, 0.0, 0.0]), _VERTICAL)


def _encode(place: Tensor, rotation: Tensor, anchor: Tensor, theta: Tensor) -> Tensor:
    rotation = facing(rotation, anchor)
    approach, r = rotation[..., :, 0], rotation[..., :, 1]
    start = reference_direction(r)
    sin = (approach * torch.linalg.cross(r, start)).sum(-1)
    cos = (approach * start).sum(-1)
    angle = torch.stack([sin, cos], -1) - theta
    parts = (place, r - anchor, angle)
    shape = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return torch.cat([part.expand(*shape, part.shape[-1]) for part in parts], -1)


def _decode_rotation(residual: Tensor, anchor: Tensor, theta: Tensor) -> Tensor:
    r = _direction(anchor + residual[..., CLOSING], anchor, _NO_DIRECTION)
    sin, cos = _direction(theta + residual[..., THETA], theta, _NO_DIRECTION).unbind(-1)
    start = reference_direction(r)
    approach = cos[..., None] * start + sin[..., None] * torch.linalg.cross(r, start)
    return torch.stack([approach, r, torch.linalg.cross(approach, r)], -1)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """(..., 3, 3) a b. Not a @ b, which autocast would round to bf16: geometry needs all digits."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def _rotated(rotation: Tensor, vector: Tensor) -> Tensor:
    """(..., 3): rotations (..., 3, 3) applied to vectors (..., 3), in full precision as well."""
    return (rotation * vector[..., None, :]).sum(-1)


def _reference_point(grasp: Pose, depth: float) -> Tensor:
    return grasp.translation + depth * grasp.approach


def _direction(vector: Tensor, fallback: Tensor, shortest: float) -> Tensor:
    """Vectors (..., K) scaled to length 1; those shorter than ``shortest`` become the fallback, without a gradient."""
    length = torch.linalg.vector_norm(vector.detach(), dim=-1, keepdim=True)
    usable = length > shortest
    # Both branches of a where get a gradient: the unused one must not be infinite.
    safe = torch.where(usable, vector, fallback)
    return _normalised(safe)


def _normalised(vector: Tensor) -> Tensor:
    return vector / torch.linalg.vector_norm(vector, dim=-1, keepdim=True)


def _down(like: Tensor) -> Tensor:
    """Sin and cos of theta for an approach straight down."""
    return like.new_tensor([math.sin(math.pi / 2), 0.0])


def _ahead(like: Tensor) -> Tensor:
    """Sin and cos of a proposal's theta in its own frame."""
    return like.new_tensor([0.0, 1.0])


def _sideways(like: Tensor) -> Tensor:
    """A proposal's closing direction in its own frame."""
    return like.new_tensor([0.0, 1.0, 0.0])
