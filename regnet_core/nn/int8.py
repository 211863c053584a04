"""Layers in evaluation as products of bytes, for processors that multiply bytes several times faster than floats.

Between layers, rows hold a byte for each channel, 0 to 255 for 0 to the channel's *range*: after the rectifier nothing
is below 0. A channel's range follows from its batch normalisation, which gives numbers around ``beta`` with the
standard deviation ``gamma``: beta + 8 |gamma|. Ranges are folded into the weights on both sides (cross-layer
equalisation, Nagel et al., "Data-Free Quantization", 2019), so that a byte of 255 is 1 in every channel and no data are
needed. Weights are bytes with a scale for each output; sums are exact, in 32 bits (ops/bytes.py).

What a network takes in (positions, widths, shapes) stays float: the sum that a first layer makes of it becomes bytes in
one pass. So do the last numbers of a head.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import nn

from regnet_core.ops.bytes import (
    Layers,
    Linear,
    Sum,
    bytes_of_sum,
    floats_of_rows,
    floats_of_sum,
    largest_of_sum,
)

if TYPE_CHECKING:
    from regnet_core.nn.layers import DenseLayer

_DEVIATIONS = 8.0
"""How many standard deviations above the mean still fit."""
_LEAST_RANGE = 1e-3
"""Of a channel, as a share of the largest range of its layer: what never is above 0 must not be divided by 0."""
_FEATURES = 32
"""Rows with so many channels are features, which are not below 0; fewer are what a network takes in."""


def takes_bytes(rows: torch.Tensor) -> bool:
    """Whether rows (n, C) of floats are features, which become bytes, rather than what a network takes in."""
    return rows.shape[1] >= _FEATURES


def rounded(weight: torch.Tensor, bias: torch.Tensor | None = None) -> Linear:
    """A linear layer of a weight (C_out, C_in) and a bias (C_out,) or none, with weights of -127 to 127."""
    scale = weight.abs().amax(dim=1).clamp(min=1e-12) / 127.0
    whole = (weight / scale[:, None]).round().to(torch.int8)
    added = torch.zeros_like(scale) if bias is None else bias
    return Linear(whole.numpy(), scale.float().numpy(), added.float().numpy())


@dataclass
class ByteLayers:
    """The layers of an ``Mlp`` (layers.py), in evaluation on a CPU."""

    first_weight: torch.Tensor
    """(C_1, C_in) float32 of the first layer, for sums from 0 to 1."""
    first_bias: torch.Tensor
    """(C_1,)."""
    first_range: torch.Tensor
    """(C_1,): what 1 stands for in the first layer's numbers."""
    last_range: torch.Tensor
    """(C_out,): what 1 stands for in the last layer's numbers, where these are pooled or there is one layer."""
    after_first: Layers
    """The other layers; the last one gives bytes where ``pooled``, else what its numbers are."""
    all: Layers
    """All of them, for rows."""

    def __post_init__(self) -> None:
        self._parts: dict[tuple[int | None, int | None, bool], Layers] = {}
        self._last_unit = self.last_range.detach() / 255.0

    @classmethod
    def of(cls, layers: Sequence[DenseLayer], pooled: bool) -> ByteLayers:
        """Of layers in evaluation, of which the last one's numbers are ``pooled`` before all else, or not."""
        with torch.no_grad():
            ranges = [_range_of(layer.norm) for layer in layers]
            parts = [_folded(layer) for layer in layers]
            made = []
            for i, (weight, bias) in enumerate(parts):
                own = ranges[i] if i == 0 or pooled or i < len(layers) - 1 else torch.ones_like(ranges[i])
                given = weight if i == 0 else weight * ranges[i - 1]
                made.append((given / own[:, None], bias / own))
            linear = [rounded(weight, bias) for weight, bias in made]
        return cls(
            *made[0],
            ranges[0],
            ranges[-1],
            Layers.of(linear[1:], to_floats=not pooled),
            Layers.of(linear, to_floats=True),
        )

    def carried(self, features: torch.Tensor, start: int | None, stop: int | None, *, with_bias: bool) -> torch.Tensor:
        """The first layer's part for the input's channels ``start`` to ``stop``, applied to these (n, stop - start) ->
        (n, C_1) float32."""
        key = (start, stop, with_bias)
        if key not in self._parts:
            part = rounded(self.first_weight[:, start:stop], self.first_bias if with_bias else None)
            self._parts[key] = Layers.of([part], to_floats=True)
        return floats_of_rows(features, self._parts[key], len(self.first_bias), rectified=False)

    def of_rows(self, rows: torch.Tensor) -> torch.Tensor:
        """(n, C_out) float32 of features (n, C_in) of float32."""
        found = floats_of_rows(rows, self.all, len(self.last_range), rectified=True)
        return found * self.first_range if self._is_one else found

    def of_sum(self, product: Sum) -> torch.Tensor:
        """(n, C_out) float32 of what the first layer comes to before its rectifier."""
        if self._is_one:
            return bytes_of_sum(product) * (self.first_range / 255.0)
        return floats_of_sum(product, self.after_first, len(self.last_range))

    def pooled(self, product: Sum, offsets: torch.Tensor) -> torch.Tensor:
        """(S, C_out) float32: the maximum in each segment (S + 1,) of what the first layer comes to before its
        rectifier, after all layers; 0 in empty ones."""
        return largest_of_sum(product, self.after_first, self._last_unit, offsets)

    @property
    def _is_one(self) -> bool:
        return len(self.after_first.places) == 0


def _folded(layer: DenseLayer) -> tuple[torch.Tensor, torch.Tensor]:
    weight, bias = layer.folded()
    assert bias is not None  # the normalisation has one
    return weight.float(), bias.float()


def _range_of(norm: nn.BatchNorm1d) -> torch.Tensor:
    """(C,): the largest number that a channel can have after the rectifier, or nearly so."""
    largest = norm.bias + _DEVIATIONS * norm.weight.abs()
    return largest.clamp(min=max(_LEAST_RANGE * float(largest.max()), 1e-6)).float()
