"""Tensors on a CPU as compiled loops see them."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt
import torch

from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range


def as_array(values: torch.Tensor) -> npt.NDArray[Any]:
    """A view as numpy sees it; of bfloat16 the bits as int16."""
    values = values.detach().contiguous()
    return values.view(torch.int16).numpy() if values.dtype == torch.bfloat16 else values.numpy()


def put_rows(room: torch.Tensor, rows: torch.Tensor, found: torch.Tensor) -> None:
    """Write rows (n, C) into rows (n,) of (N, C), contiguous and of the same type. On a CPU, without gradients."""
    assert room.is_contiguous() and room.dtype == found.dtype and not found.requires_grad
    for_each_range(_put, len(rows), 0.3 * room.shape[1], rows.numpy(), as_array(found), as_array(room))


@compiled
def _put(begin, end, rows, found, room):  # type: ignore[no-untyped-def]
    for i in range(begin, end):
        target, source = room[rows[i]], found[i]
        for c in range(len(source)):
            target[c] = source[c]
