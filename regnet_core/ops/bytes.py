"""Rows of bytes through linear layers, for nn/int8.py: a byte of 255 is 1, and what is below 0 becomes 0.

A tile of rows goes through all layers in one go: what it becomes on its way stays in the core's fastest cache, and
Python is asked once for all tiles, not once for each layer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from regnet_core.ops.byte_products import COLUMNS, ROWS, packed, products_to_bytes, products_to_floats, sum_to_bytes
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range

_TILE = 96
"""Rows of a tile; full blocks of products."""
_LOWEST = np.float32(-np.finfo(np.float32).max)


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


class Sum(NamedTuple):
    """Rows (E, C) that are the sum of what is given, at least one of the first three."""

    gathered: Gathered | None = None
    """E rows."""
    own: Own | None = None
    """E rows."""
    rows: torch.Tensor | None = None
    """(E, C) float32."""
    bias: torch.Tensor | None = None
    """(C,) float32, added to every row."""

    @property
    def shape(self) -> tuple[int, int]:
        """E and C."""
        if self.gathered is not None:
            return len(self.gathered.indices), self.gathered.values.shape[1]
        if self.own is not None:
            return len(self.own.columns), self.own.weight.shape[1]
        assert self.rows is not None  # something has rows
        return self.rows.shape[0], self.rows.shape[1]


class Linear(NamedTuple):
    """A layer: rows @ weight^T * scale + bias."""

    weight: npt.NDArray[np.int8]
    """(C_out, C_in)."""
    scale: npt.NDArray[np.float32]
    """(C_out,): what a byte of 1 of the weights stands for."""
    bias: npt.NDArray[np.float32]
    """(C_out,)."""


class Layers(NamedTuple):
    """Layers one after the other, with a rectifier and bytes between them, in the order that products read them."""

    weights: npt.NDArray[np.int8]
    """Of all layers."""
    scales: npt.NDArray[np.float32]
    """Of all layers' blocks of columns, for bytes that go in and bytes that come out, or floats after the last."""
    biases: npt.NDArray[np.float32]
    """The same."""
    places: npt.NDArray[np.int64]
    """(L, 4): fours of inputs, blocks of columns, and where the layer's weights and columns begin."""
    blocks: int
    """Blocks of columns of the widest layer."""

    @classmethod
    def of(cls, layers: Sequence[Linear], *, to_floats: bool) -> Layers:
        """Of any number of layers. The last one gives bytes, or what it comes to in float32."""
        weights, scales, biases, places = [np.zeros(0, np.int8)], [], [], []
        at, column = 0, 0
        for number, layer in enumerate(layers):
            outputs, inputs = layer.weight.shape
            fours, blocks = -(-inputs // 4), -(-outputs // COLUMNS)
            room = blocks * COLUMNS - outputs
            floats = to_floats and number == len(layers) - 1
            unit, half = (1.0, 0.0) if floats else (255.0, 0.5)
            weights.append(packed(layer.weight))
            scales.append(np.pad(layer.scale * (unit / 255.0), (0, room)))
            biases.append(np.pad(layer.bias * unit, (0, room)) + half)
            places.append((fours, blocks, at, column))
            at, column = at + len(weights[-1]), column + blocks * COLUMNS
        return cls(
            np.concatenate(weights),
            np.concatenate([np.zeros(0), *scales]).astype(np.float32),
            np.concatenate([np.zeros(0), *biases]).astype(np.float32),
            np.array(places, np.int64).reshape(-1, 4),
            max((place[1] for place in places), default=0),
        )


class _Source(NamedTuple):
    """A sum as arrays with full blocks of columns; of what is not given there is nothing, or one zero row for all."""

    start: npt.NDArray[np.float32]
    bias: npt.NDArray[np.float32]
    indices: npt.NDArray[np.int64]
    values: npt.NDArray[np.float32]
    shares: npt.NDArray[np.float32]
    columns: npt.NDArray[np.float32]
    weight: npt.NDArray[np.float32]

    @classmethod
    def of(cls, given: Sum) -> _Source:
        count, channels = given.shape
        zeros = np.zeros((1, -(-channels // COLUMNS) * COLUMNS), np.float32)
        indices, values, shares = np.zeros((count, 0), np.int64), zeros, np.ones((1, 1), np.float32)
        if given.gathered is not None:
            indices, values = _array(given.gathered.indices), _blocks(given.gathered.values)
            shares = shares if given.gathered.weights is None else _array(given.gathered.weights)
        columns, weight = np.zeros((count, 0), np.float32), zeros
        if given.own is not None:
            columns, weight = _array(given.own.columns), _blocks(given.own.weight)
        start = zeros if given.rows is None else _blocks(given.rows)
        bias = zeros if given.bias is None else _blocks(given.bias[None])
        return cls(start, bias, indices, values, shares, columns, weight)


def largest_of_sum(given: Sum, layers: Layers, unit: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    """The largest of each channel in each segment of what the layers make of a sum -> (S, C_out) float32.

    Args:
        given: E rows.
        layers: any number, that give bytes.
        unit: (C_out,) float32, what a byte of 1 stands for in each channel of the last layer, or of the sum without
            layers.
        offsets: (S + 1,) int64, from 0 to E. Empty segments have 0.
    """
    source, bounds = _Source.of(given), offsets.numpy()
    top = torch.empty((len(bounds) - 1, len(unit)))
    each = _row_time(layers) * given.shape[0] / max(len(top), 1)
    width = _width(given.shape[1], layers)
    for_each_range(_largest, len(top), each, source, layers, width, bounds, unit.numpy(), top.numpy())
    return top


def floats_of_sum(given: Sum, layers: Layers, outputs: int) -> torch.Tensor:
    """What the layers, at least one, make of a sum of E rows -> (E, outputs) float32, none below 0."""
    source, (count, channels) = _Source.of(given), given.shape
    out, width = _floats(count, layers), _width(channels, layers)
    for_each_range(_floats_of_sum, _tiles(count), _TILE * _row_time(layers), source, layers, width, count, out)
    return torch.from_numpy(out)[:count, :outputs]


def bytes_of_sum(given: Sum) -> torch.Tensor:
    """255 times a sum of E rows, rounded, and no less than 0 and no more than 255 -> (E, C) uint8."""
    source, (count, channels) = _Source.of(given), given.shape
    out = np.empty((-(-count // ROWS) * ROWS, len(source.bias[0])), np.uint8)

    for_each_range(_sums, len(out) // ROWS, ROWS * 0.3 * channels, source, count, out)
    return torch.from_numpy(out)[:count, :channels]


def floats_of_rows(rows: torch.Tensor, layers: Layers, outputs: int, *, rectified: bool) -> torch.Tensor:
    """What the layers, at least one, make of rows (E, C) float32, none of which is below 0 -> (E, outputs) float32."""
    source, count = _array(rows), len(rows)
    most = np.zeros(_tiles(count), np.float32)
    for_each_range(_most, len(most), _TILE * 0.05 * rows.shape[1], source, most)
    largest = float(most.max(initial=0.0)) or 1.0
    out, width = _floats(count, layers), _width(rows.shape[1], layers)
    least = np.float32(0.0) if rectified else _LOWEST
    for_each_range(
        _floats_of_rows,
        _tiles(count),
        _TILE * _row_time(layers),
        source,
        np.float32(largest),
        layers,
        width,
        least,
        out,
    )
    return torch.from_numpy(out)[:count, :outputs]


def _width(channels: int, layers: Layers) -> int:
    """Bytes of a row's room for what goes in and comes out of each layer."""
    return COLUMNS * max(-(-channels // COLUMNS), layers.blocks)


def _row_time(layers: Layers) -> float:
    """About how long a row takes on one core [ns]."""
    return 20.0 + layers.weights.size / 190


def _tiles(count: int) -> int:
    return -(-count // _TILE)


def _floats(count: int, layers: Layers) -> npt.NDArray[np.float32]:
    """Room for what the last layer gives: full blocks."""
    return np.empty((-(-count // ROWS) * ROWS, int(layers.places[-1, 1]) * COLUMNS), np.float32)


def _array(values: torch.Tensor) -> npt.NDArray[Any]:
    return values.detach().contiguous().numpy()


def _blocks(values: torch.Tensor) -> npt.NDArray[np.float32]:
    """Rows of full blocks of columns."""
    missing = -values.shape[1] % COLUMNS
    return _array(torch.nn.functional.pad(values, (0, missing)) if missing else values)


@compiled
def _most(begin, end, rows, most):  # type: ignore[no-untyped-def]
    """The largest number of each tile, none of which is below 0."""
    for tile in range(begin, end):
        numbers = rows[tile * _TILE : (tile + 1) * _TILE].reshape(-1)
        lanes, whole = np.zeros(COLUMNS, np.float32), len(numbers) // COLUMNS
        for block in range(whole):
            for c in range(COLUMNS):
                value = numbers[block * COLUMNS + c]
                lanes[c] = value if value > lanes[c] else lanes[c]
        largest = lanes.max()
        for e in range(whole * COLUMNS, len(numbers)):
            largest = max(largest, numbers[e])
        most[tile] = largest


@compiled
def _largest(begin, end, source, layers, width, offsets, unit, largest):  # type: ignore[no-untyped-def]
    top = np.zeros((end - begin, len(unit)), np.uint8)
    one, other = np.empty((_TILE, width), np.uint8), np.empty((_TILE, width), np.uint8)
    segment, stop = begin, offsets[end]
    for first in range(offsets[begin], stop, _TILE):
        last = min(first + _TILE, stop)
        _sum(source, first, last, one)
        made = _through(layers, layers.scales, len(layers.places), last - first, one, other)
        for e in range(last - first):
            while offsets[segment + 1] <= first + e:
                segment += 1
            highest, row = top[segment - begin], made[e]
            for c in range(len(highest)):
                highest[c] = max(highest[c], row[c])
    for s in range(len(top)):
        for c in range(len(unit)):
            largest[begin + s, c] = np.float32(top[s, c]) * unit[c]


@compiled
def _floats_of_sum(begin, end, source, layers, width, count, out):  # type: ignore[no-untyped-def]
    one, other = np.empty((_TILE, width), np.uint8), np.empty((_TILE, width), np.uint8)
    for tile in range(begin, end):
        first = tile * _TILE
        last = min(first + _TILE, count)
        _sum(source, first, last, one)
        made = _through(layers, layers.scales, len(layers.places) - 1, last - first, one, other)
        _end(layers, layers.scales, last - first, made, np.float32(0.0), out[first:])


@compiled
def _sums(begin, end, source, count, out):  # type: ignore[no-untyped-def]
    _sum(source, begin * ROWS, min(end * ROWS, count), out[begin * ROWS :])


@compiled
def _floats_of_rows(begin, end, rows, largest, layers, width, least, out):  # type: ignore[no-untyped-def]
    scales, first_columns = layers.scales.copy(), layers.places[0, 1] * COLUMNS
    for c in range(first_columns):  # a byte of 1 is largest / 255, not 1 / 255
        scales[c] *= largest
    scale = np.float32(255.0 / largest)
    one, other = np.empty((_TILE, width), np.uint8), np.empty((_TILE, width), np.uint8)
    half, most = np.float32(0.5), np.float32(255.0)
    for tile in range(begin, end):
        first = tile * _TILE
        last = min(first + _TILE, len(rows))
        for e in range(last - first):
            row, taken = rows[first + e], one[e]
            for c in range(len(row)):
                scaled = row[c] * scale + half
                taken[c] = np.uint8(np.int32(scaled if scaled < most else most))
        made = _through(layers, scales, len(layers.places) - 1, last - first, one, other)
        _end(layers, scales, last - first, made, least, out[first:])


@compiled
def _through(layers, scales, count, rows, given, room):  # type: ignore[no-untyped-def]
    """What the first layers make of rows in ``given``: in that array or in ``room``, which has as much of it."""
    for number in range(count):
        _apply(layers, scales, number, rows, given, np.float32(0.0), False, room.ctypes.data, room.shape[1])
        given, room = room, given
    return given


@compiled
def _end(layers, scales, rows, given, least, out):  # type: ignore[no-untyped-def]
    """What the last layer makes of rows in ``given``, into the first rows of ``out``."""
    _apply(layers, scales, len(layers.places) - 1, rows, given, least, True, out.ctypes.data, 4 * out.shape[1])


@compiled
def _apply(layers, scales, number, rows, given, least, to_floats, out, out_stride):  # type: ignore[no-untyped-def]
    """A layer on rows in ``given``, to rows at the address ``out`` that are so many bytes apart."""
    fours, blocks, at, column = layers.places[number]
    stride, size = given.shape[1], 4 if to_floats else 1
    for part in range(blocks):
        weight = layers.weights.ctypes.data + at + part * fours * 4 * COLUMNS
        first = 4 * (column + part * COLUMNS)
        scale, bias = scales.ctypes.data + first, layers.biases.ctypes.data + first
        for row in range(0, rows, ROWS):
            source = given.ctypes.data + row * stride
            target = out + row * out_stride + size * part * COLUMNS
            if to_floats:
                products_to_floats(source, stride, weight, fours, scale, bias, least, target, out_stride)
            else:
                products_to_bytes(source, stride, weight, fours, scale, bias, least, target, out_stride)


@compiled
def _sum(source, begin, end, out):  # type: ignore[no-untyped-def]
    """Rows of a sum into the first rows of ``out``, which has room for full blocks."""
    start, bias, indices, values, shares, columns, weight = source
    start_stride = 0 if len(start) == 1 else 4 * start.shape[1]
    share_stride = 0 if shares.size == 1 else 4
    for row in range(begin, end, ROWS):
        target = out.ctypes.data + (row - begin) * out.shape[1]
        for first in range(0, bias.shape[1], COLUMNS):
            sum_to_bytes(  # type: ignore[call-arg]
                row, end, 4 * first,
                start.ctypes.data, start_stride, bias.ctypes.data,
                indices.shape[1], indices.ctypes.data, values.ctypes.data, 4 * values.shape[1],
                shares.ctypes.data, share_stride,
                columns.shape[1], columns.ctypes.data, weight.ctypes.data, 4 * weight.shape[1],
                target + first, out.shape[1],
            )  # fmt: skip
