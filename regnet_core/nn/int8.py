"""Layers in evaluation as products of bytes, for processors that multiply bytes several times faster than floats.

Between layers, rows hold a byte for each channel, 0 to 255 for 0 to the channel's *range*: after the rectifier nothing
is below 0. A channel's range follows from its batch normalisation, which gives numbers around ``beta`` with the
standard deviation ``gamma``: beta + 8 |gamma|. Ranges are folded into the weights on both sides (cross-layer
equalisation, Nagel et al., "Data-Free Quantization", 2019), so that a byte of 255 is 1 in every channel and no data are
needed. Weights are bytes with a scale for each output; sums are exact, in 32 bits.

What a network takes in (positions, widths, shapes) stays float: the sum that a first layer makes of it becomes bytes in
one pass. So do the last numbers of a head.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import nn

from regnet_core.nn.tiles import BYTES_TILE, one_by_one, tiles
from regnet_core.ops.bytes import bytes_of_rows

if TYPE_CHECKING:
    from regnet_core.nn.layers import DenseLayer

_DEVIATIONS = 8.0
"""How many standard deviations above the mean still fit."""
_LEAST_RANGE = 1e-3
"""Of a channel, as a share of the largest range of its layer: what never is above 0 must not be divided by 0."""
_ROWS = 4096
"""Of the tiles that weights are put in order for; others work."""
_FEATURES = 32
"""Rows with so many channels are features, which are not below 0; fewer are what a network takes in."""


class Packed(NamedTuple):
    """A linear layer."""

    weight: torch.Tensor
    """Bytes, in oneDNN's order."""
    scale: torch.Tensor
    """(C_out,): what a byte of 1 stands for."""
    zero: torch.Tensor
    """(C_out,) int32 zeros."""
    bias: torch.Tensor | None
    """(C_out,)."""

    @classmethod
    def of(cls, weight: torch.Tensor, bias: torch.Tensor | None) -> Packed:
        """Of a weight (C_out, C_in) and a bias (C_out,) or none."""
        scale = weight.abs().amax(dim=1).clamp(min=1e-12) / 127.0
        rounded = (weight / scale[:, None]).round().to(torch.int8)
        packed = torch.ops.onednn.qlinear_prepack(rounded, [_ROWS, rounded.shape[1]])
        return cls(packed, scale.float(), torch.zeros(len(scale), dtype=torch.int32), bias)

    def __call__(self, rows: torch.Tensor, unit: float, *, rectified: bool, as_bytes: bool) -> torch.Tensor:
        """The product with rows (n, C_in) of bytes, of which 1 stands for ``unit``: float32, or bytes for 0 to 1."""
        product: torch.Tensor = torch.ops.onednn.qlinear_pointwise(
            rows, unit, 0, self.weight, self.scale, self.zero, self.bias,
            1.0 / 255.0 if as_bytes else 1.0, 0, torch.uint8 if as_bytes else torch.float32,
            "relu" if rectified else "none", [], "",
        )  # fmt: skip
        return product


def takes_bytes(rows: torch.Tensor) -> bool:
    """Whether rows (n, C) of floats are features, which become bytes, rather than what a network takes in."""
    return rows.shape[1] >= _FEATURES


def product_of_features(packed: Packed, features: torch.Tensor) -> torch.Tensor:
    """The linear layer's product with features (n, C_in) of float32 -> (n, C_out) float32."""
    rows, unit = bytes_of_rows(features)
    return packed(rows, unit, rectified=False, as_bytes=False)[: len(features)]


@dataclass
class ByteLayers:
    """The layers of an ``Mlp`` (layers.py), in evaluation on a CPU."""

    first_weight: torch.Tensor
    """(C_1, C_in) float32 of the first layer, for sums from 0 to 1."""
    first_bias: torch.Tensor
    """(C_1,)."""
    first_range: torch.Tensor
    """(C_1,)."""
    rest: tuple[Packed, ...]
    """The other layers; the last one gives numbers from 0 to 1 where ``pooled``, else what they are."""
    last_range: torch.Tensor
    """(C_out,): what 1 stands for in the last layer's numbers."""
    pooled: bool

    def __post_init__(self) -> None:
        self._parts: dict[tuple[int | None, int | None, bool], Packed] = {}

    @classmethod
    def of(cls, layers: Sequence[DenseLayer], pooled: bool) -> ByteLayers:
        """Of layers in evaluation."""
        with torch.no_grad():
            ranges = [_range_of(layer.norm) for layer in layers]
            parts = [_folded(layer) for layer in layers]
            rest = []
            for i in range(1, len(layers)):
                weight, bias = parts[i]
                own = ranges[i] if pooled or i < len(layers) - 1 else torch.ones_like(ranges[i])
                rest.append(Packed.of(weight * ranges[i - 1] / own[:, None], bias / own))
            weight, bias = parts[0]
            first = ranges[0]
        return cls(weight / first[:, None], bias / first, first, tuple(rest), ranges[-1], pooled)

    def first(self, start: int | None, stop: int | None, with_bias: bool) -> Packed:
        """The first layer for the input's channels ``start`` to ``stop``."""
        key = (start, stop, with_bias)
        if key not in self._parts:
            self._parts[key] = Packed.of(self.first_weight[:, start:stop], self.first_bias if with_bias else None)
        return self._parts[key]

    def of_rows(self, rows: torch.Tensor) -> torch.Tensor:
        """(n, C_out) float32 of features (n, C_in) of float32."""
        (taken, unit), first = bytes_of_rows(rows), self.first(None, None, True)

        def tile(some: slice) -> torch.Tensor:
            return self.after_first(first(taken[some], unit, rectified=True, as_bytes=True))

        return one_by_one(tile, tiles(len(taken), BYTES_TILE))[: len(rows)]

    def after_first(self, rows: torch.Tensor) -> torch.Tensor:
        """(n, C_out) float32 of what the first layer gives (n, C_1), in bytes."""
        for packed in self.rest[:-1]:
            rows = packed(rows, 1.0 / 255.0, rectified=True, as_bytes=True)
        if not self.rest:
            return rows * (self.first_range / 255.0)
        return self.rest[-1](rows, 1.0 / 255.0, rectified=True, as_bytes=False)

    def to_pool(self, rows: torch.Tensor) -> torch.Tensor:
        """(n, C_out) in bytes of what the first layer gives (n, C_1), in bytes."""
        for packed in self.rest:
            rows = packed(rows, 1.0 / 255.0, rectified=True, as_bytes=True)
        return rows

    def pooled_values(self, rows: torch.Tensor) -> torch.Tensor:
        """(n, C_out) float32 of bytes that ``to_pool`` gave."""
        return rows * (self.last_range / 255.0)


def _folded(layer: DenseLayer) -> tuple[torch.Tensor, torch.Tensor]:
    weight, bias = layer.folded()
    assert bias is not None  # the normalisation has one
    return weight.float(), bias.float()


def _range_of(norm: nn.BatchNorm1d) -> torch.Tensor:
    """(C,): the largest number that a channel can have after the rectifier, or nearly so."""
    largest = norm.bias + _DEVIATIONS * norm.weight.abs()
    return largest.clamp(min=max(_LEAST_RANGE * float(largest.max()), 1e-6)).float()


@cache
def has_byte_products() -> bool:
    """Whether this torch multiplies bytes as these layers need it; found out by trying."""
    try:
        generator = torch.Generator().manual_seed(0)
        weight = torch.randn(32, 48, generator=generator)
        rows = torch.randint(0, 256, (40, 48), generator=generator, dtype=torch.uint8)
        expected = torch.relu(rows.float() / 255.0 @ weight.t() + 0.5)
        found = Packed.of(weight, torch.full((32,), 0.5))(rows, 1.0 / 255.0, rectified=True, as_bytes=False)
    except (AttributeError, RuntimeError, NotImplementedError):
        return False
    return bool((found - expected).abs().max() < 0.02 * expected.max())
