"""Rows of bytes for products in int8: rows made from floats, the sums that a first layer is, and maxima of bytes.

A byte v stands for v / 255 of the largest value that its channel can have; what that is, nn/int8.py knows.

oneDNN prepares a product anew for every number of rows that it has not seen, which takes longer than most products.
Numbers of neighbours differ from cloud to cloud, so rows are given room for the next round number: what is in the rest
of it means nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from regnet_core.ops.compiled import compiled, inlined
from regnet_core.ops.parallel import for_each_range


class Gathered(NamedTuple):
    """Sums of other rows: row e of (E, C) is the sum over j of weights[e, j] * values[indices[e, j]]."""

    values: torch.Tensor
    """(M, C) float32."""
    indices: torch.Tensor
    """(E, J) int64."""
    weights: torch.Tensor | None = None
    """(E, J) float32; None: 1."""


class Own(NamedTuple):
    """Products of few columns: row e of (E, C) is columns[e] @ weight."""

    columns: torch.Tensor
    """(E, K) float32."""
    weight: torch.Tensor
    """(K, C) float32."""


def room_for(rows: int) -> int:
    """The next number that has at most four binary digits before zeros, at least 256: an eighth more at most."""
    if rows <= 256:
        return 256
    shift = rows.bit_length() - 4
    return -(-rows >> shift) << shift


def bytes_of_sum(
    gathered: Gathered | None = None,
    own: Own | None = None,
    rows: torch.Tensor | None = None,
    bias: torch.Tensor | None = None,
) -> torch.Tensor:
    """255 times the sum of what is given, rounded, and no less than 0 and no more than 255: E rows (E, C), in a tensor
    (room_for(E), C) of uint8.

    Args:
        gathered: E rows.
        own: E rows.
        rows: (E, C) float32.
        bias: (C,) float32, added to every row.
    """
    count, channels = _shape(gathered, own, rows)
    out = torch.empty((room_for(count), channels), dtype=torch.uint8)
    none, no_index = np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int64)
    values, indices, weights = (none, no_index, none) if gathered is None else map(_array, gathered)
    columns, weight = (none, none) if own is None else map(_array, own)
    direct = none if rows is None else _array(rows)
    added = np.zeros(channels, np.float32) if bias is None else _array(bias)
    target = out.numpy()

    def run(start: int, stop: int) -> None:
        _sum(values, indices, weights, columns, weight, direct, added, start, stop, target)

    for_each_range(run, count, least=512)
    return out


def bytes_of_rows(rows: torch.Tensor) -> tuple[torch.Tensor, float]:
    """Rows (n, C) of float32, none below 0, as bytes (room_for(n), C), and what a byte of 1 stands for."""
    largest = float(rows.amax()) if rows.numel() else 0.0
    shape = (room_for(len(rows)), rows.shape[1])
    if not largest > 0.0:
        return torch.zeros(shape, dtype=torch.uint8), 1.0
    out = torch.empty(shape, dtype=torch.uint8)
    source, target, scale = _array(rows), out.numpy(), np.float32(255.0 / largest)
    for_each_range(lambda a, z: _scaled(source, scale, a, z, target), len(rows), least=512)
    return out, largest / 255.0


def largest_bytes(values: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    """(S, C) uint8: the largest of each channel in each segment of the values (E or more, C), given offsets (S + 1,); 0
    in empty ones."""
    top = torch.zeros((len(offsets) - 1, values.shape[1]), dtype=torch.uint8)
    source, target, bounds = values.numpy(), top.numpy(), offsets.numpy()
    for_each_range(lambda a, z: _largest(source, bounds, a, z, target), len(top), least=64)
    return top


def _shape(gathered: Gathered | None, own: Own | None, rows: torch.Tensor | None) -> tuple[int, int]:
    if gathered is not None:
        return len(gathered.indices), gathered.values.shape[1]
    if own is not None:
        return len(own.columns), own.weight.shape[1]
    assert rows is not None  # something has rows
    return rows.shape[0], rows.shape[1]


def _array(values: torch.Tensor | None) -> npt.NDArray[Any]:
    return np.zeros((0, 0), np.float32) if values is None else values.detach().contiguous().numpy()


@inlined
def _byte(value):  # type: ignore[no-untyped-def]
    scaled = value * np.float32(255.0) + np.float32(0.5)
    scaled = scaled if scaled > np.float32(0.0) else np.float32(0.0)
    scaled = scaled if scaled < np.float32(255.0) else np.float32(255.0)
    return np.uint8(np.int32(scaled))  # processors convert to 32 bits, many numbers at a time


@compiled
def _sum(values, indices, weights, columns, weight, rows, bias, begin, end, out):  # type: ignore[no-untyped-def]
    """Each row in as few passes as can be: what is written down between two of them costs as much as the sums."""
    channels, gathers, own = out.shape[1], indices.shape[1], columns.shape[1]
    weighted, direct = len(weights) > 0, len(rows) > 0
    one, none = np.float32(1.0), np.float32(0.0)
    total = np.empty(channels, np.float32)
    for e in range(begin, end):
        start = rows[e] if direct else bias
        add = one if direct else none
        if gathers == 1:
            row = values[indices[e, 0]]
            share = weights[e, 0] if weighted else one
            for c in range(channels):
                total[c] = start[c] + add * bias[c] + share * row[c]
        elif gathers == 3:
            first, second, third = values[indices[e, 0]], values[indices[e, 1]], values[indices[e, 2]]
            a = weights[e, 0] if weighted else one
            b = weights[e, 1] if weighted else one
            d = weights[e, 2] if weighted else one
            for c in range(channels):
                total[c] = start[c] + add * bias[c] + a * first[c] + b * second[c] + d * third[c]
        else:
            for c in range(channels):
                total[c] = start[c] + add * bias[c]
            for j in range(gathers):
                row = values[indices[e, j]]
                share = weights[e, j] if weighted else one
                for c in range(channels):
                    total[c] += share * row[c]
        k = 0
        while k + 4 < own:
            p, q, r, s = columns[e, k], columns[e, k + 1], columns[e, k + 2], columns[e, k + 3]
            for c in range(channels):
                total[c] += p * weight[k, c] + q * weight[k + 1, c] + r * weight[k + 2, c] + s * weight[k + 3, c]
            k += 4
        if own - k == 4:
            p, q, r, s = columns[e, k], columns[e, k + 1], columns[e, k + 2], columns[e, k + 3]
            for c in range(channels):
                out[e, c] = _byte(
                    total[c] + p * weight[k, c] + q * weight[k + 1, c] + r * weight[k + 2, c] + s * weight[k + 3, c]
                )
        elif own - k == 3:
            p, q, r = columns[e, k], columns[e, k + 1], columns[e, k + 2]
            for c in range(channels):
                out[e, c] = _byte(total[c] + p * weight[k, c] + q * weight[k + 1, c] + r * weight[k + 2, c])
        elif own - k == 2:
            p, q = columns[e, k], columns[e, k + 1]
            for c in range(channels):
                out[e, c] = _byte(total[c] + p * weight[k, c] + q * weight[k + 1, c])
        elif own - k == 1:
            p = columns[e, k]
            for c in range(channels):
                out[e, c] = _byte(total[c] + p * weight[k, c])
        else:
            for c in range(channels):
                out[e, c] = _byte(total[c])


@compiled
def _scaled(rows, scale, begin, end, out):  # type: ignore[no-untyped-def]
    half, top = np.float32(0.5), np.float32(255.0)
    for e in range(begin, end):
        for c in range(rows.shape[1]):
            scaled = rows[e, c] * scale + half
            out[e, c] = np.uint8(np.int32(scaled if scaled < top else top))


@compiled
def _largest(values, offsets, begin, end, top):  # type: ignore[no-untyped-def]
    for s in range(begin, end):
        for e in range(offsets[s], offsets[s + 1]):
            for c in range(values.shape[1]):
                top[s, c] = max(top[s, c], values[e, c])
