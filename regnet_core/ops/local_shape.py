"""The shape of the surface around each point: which way it faces, and whether it is flat, an edge or a speck.

It is the covariance of the points within a radius, divided by its trace. On a flat surface with the normal n it is
(1 - n n^T) / 2: it says the same as a normal, but has no sign to be guessed, and is nothing sudden where the surface
bends or the points are few.
"""

from __future__ import annotations

import torch

from regnet_core.ops.buckets import Buckets, in_buckets
from regnet_core.ops.compiled import compiled
from regnet_core.ops.gpu import has_kernels
from regnet_core.ops.local_planes import relative_covariances
from regnet_core.ops.parallel import for_each_range

SHAPE_CHANNELS = 6
"""xx, yy, zz, xy, xz, yz of the tensor."""
_ROWS, _COLUMNS = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)
_LEAST_TRACE = 1e-8
"""Less than a tenth of a millimetre squared: such points have no shape [m2]."""
_CHUNK = 1 << 24
"""Pairs of points that the search in torch looks at in one go."""


def local_shapes(points: torch.Tensor, radius: float, buckets: Buckets | None = None) -> torch.Tensor:
    """(N, 3, 3) float32: 3 C / trace(C) - 1, with C the covariance of the points within a radius of each.

    Args:
        points: (N, 3) [m].
        radius: [m].
        buckets: of the points, from ``point_buckets``, where there are some already.

    A flat surface with the normal z gives diag(0.5, 0.5, -1), points on a line along z diag(-1, -1, 2), and points
    without neighbours 0.
    """
    if points.device.type == "cpu":
        given = buckets or in_buckets(points.detach().float().numpy())
        return torch.from_numpy(relative_covariances(given, radius, _LEAST_TRACE))
    if has_kernels(points):
        from regnet_core.ops.gpu.moments import covariance_on_gpu

        covariance = covariance_on_gpu(points.detach(), radius)
    else:
        covariance = covariance_in_torch(points.detach(), radius)
    trace = covariance.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None]
    shape = 3.0 * covariance / trace.clamp(min=_LEAST_TRACE) - torch.eye(
        3, dtype=covariance.dtype, device=points.device
    )
    return torch.where(trace >= _LEAST_TRACE, shape, torch.zeros_like(shape)).float()


def covariance_in_torch(points: torch.Tensor, radius: float) -> torch.Tensor:
    """(N, 3, 3) float64 [m2], on any device: every point is compared with every other."""
    at = points.double() - points.double().mean(dim=0)
    products = torch.cat([torch.ones_like(at[:, :1]), at, at[:, _ROWS] * at[:, _COLUMNS]], dim=1)
    parts = []
    for some in at.split(max(1, _CHUNK // max(1, len(at)))):
        near = torch.cdist(some, at, compute_mode="donot_use_mm_for_euclid_dist") <= radius
        parts.append(near.double() @ products)
    sums = torch.cat(parts) if parts else products
    sums = sums / sums[:, :1]
    return symmetric(sums[:, 4:] - sums[:, 1:4][:, _ROWS] * sums[:, 1:4][:, _COLUMNS])


def unique_entries(tensor: torch.Tensor) -> torch.Tensor:
    """(N, 6) of symmetric tensors (N, 3, 3): xx, yy, zz, xy, xz, yz."""
    if tensor.device.type != "cpu" or tensor.dtype != torch.float32 or tensor.requires_grad:
        return tensor[:, _ROWS, _COLUMNS]
    entries = torch.empty((len(tensor), 6))
    for_each_range(_list_entries, len(tensor), 3, tensor.contiguous().numpy(), entries.numpy())
    return entries


@compiled
def _list_entries(begin, end, tensors, entries):  # type: ignore[no-untyped-def]
    for n in range(begin, end):
        s, row = tensors[n], entries[n]
        row[0], row[1], row[2] = s[0, 0], s[1, 1], s[2, 2]
        row[3], row[4], row[5] = s[0, 1], s[0, 2], s[1, 2]


def symmetric(entries: torch.Tensor) -> torch.Tensor:
    """(N, 3, 3) of their unique entries (N, 6)."""
    xx, yy, zz, xy, xz, yz = entries.unbind(dim=1)
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=1).reshape(-1, 3, 3)


def turned(tensor: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
    """R^T S R of symmetric tensors (N, 3, 3), as seen in frames R (N, 3, 3); in full precision under autocast too."""
    half = (tensor[:, :, :, None] * rotation[:, None, :, :]).sum(dim=2)
    return (rotation[:, :, :, None] * half[:, :, None, :]).sum(dim=1)
