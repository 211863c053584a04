"""The layer that the whole network is made of: linear, batch normalisation, rectifier.

In evaluation batch normalisation is folded into the linear part. Callers that compute W x in parts (propagation.py,
pooling.py) take W and the bias from ``linear_part`` and hand the sum to ``finish``.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple, cast

import torch
from torch import nn
from torch.nn import functional

from regnet_core.nn.int8 import ByteLayers, takes_bytes
from regnet_core.nn.tiles import TILE, in_one_go, over_tiles


class LinearPart(NamedTuple):
    """What the rows of a layer are multiplied with, before ``finish``."""

    weight: torch.Tensor
    """(C_out, C_in)."""
    bias: torch.Tensor | None
    """(C_out,); None in training."""


class DenseLayer(nn.Module):
    """A linear layer without bias, batch normalisation over the rows, and a rectifier: (n, C_in) -> (n, C_out)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)
        self._folded: dict[torch.dtype, LinearPart] = {}
        nn.init.kaiming_normal_(self.linear.weight, nonlinearity="relu")

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        return self.finish(functional.linear(rows, *self.linear_part()))

    def linear_part(self) -> LinearPart:
        """W in training; in evaluation W and a bias that hold the normalisation too.

        Without gradients these are made once, in the type that the products are computed in, and kept until the mode,
        the device or the numbers change: after changing parameters in place, call ``eval()`` again.
        """
        if self.training:
            return LinearPart(self.linear.weight, None)
        if torch.is_grad_enabled():
            return self.folded()
        device = self.linear.weight.device.type
        autocast = torch.is_autocast_enabled(device)
        dtype = torch.get_autocast_dtype(device) if autocast else self.linear.weight.dtype
        if dtype not in self._folded:
            with torch.autocast(device, enabled=False):
                weight, bias = self.folded()
                self._folded[dtype] = LinearPart(weight.to(dtype), None if bias is None else bias.to(dtype))
        return self._folded[dtype]

    def folded(self) -> LinearPart:
        """W and the bias with the normalisation of evaluation in them, in single precision."""
        norm = self.norm
        mean, variance = norm.running_mean, norm.running_var
        assert mean is not None and variance is not None  # the layer keeps statistics
        scale = norm.weight * torch.rsqrt(variance + norm.eps)
        return LinearPart(self.linear.weight * scale[:, None], norm.bias - mean * scale)

    def train(self, mode: bool = True) -> DenseLayer:
        """Training or evaluation; either way what was folded before is forgotten."""
        self._folded.clear()
        return super().train(mode)

    def _apply(self, fn: Any, recurse: bool = True) -> DenseLayer:
        self._folded.clear()
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        self._folded.clear()
        super()._load_from_state_dict(*args, **kwargs)

    def finish(self, product: torch.Tensor) -> torch.Tensor:
        """The output, given what the linear part gives, which is overwritten."""
        if self.training:
            product = self._normalised(product)
        return functional.relu(product, inplace=True)

    def _normalised(self, product: torch.Tensor) -> torch.Tensor:
        if len(product) > 1:
            return cast(torch.Tensor, self.norm(product))
        # One row has no variance to normalise with, and would spoil the running statistics.
        norm = self.norm
        return functional.batch_norm(product, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=norm.eps)


class Mlp(nn.ModuleList):
    """Dense layers one after the other, shared by all rows: (n, C_in) -> (n, C_out)."""

    pools = False
    """Whether the rows that the last layer gives are pooled before anything else."""

    def __init__(self, inputs: int, channels: Sequence[int]) -> None:
        sizes = (inputs, *channels)
        super().__init__(DenseLayer(a, b) for a, b in pairwise(sizes))
        self._bytes: ByteLayers | None = None

    def use_bytes(self) -> None:
        """Compute with bytes (int8.py) on a CPU, where no gradients are wanted, until the mode changes."""
        self._bytes = ByteLayers.of(cast("list[DenseLayer]", list(self)), self.pools)

    def in_bytes(self) -> ByteLayers | None:
        """The layers that compute with bytes, where these are to be used."""
        return None if torch.is_grad_enabled() else self._bytes

    def train(self, mode: bool = True) -> Mlp:
        """Training or evaluation; either way without bytes."""
        self._bytes = None
        return super().train(mode)

    def _apply(self, fn: Any, recurse: bool = True) -> Mlp:
        self._bytes = None
        return super()._apply(fn, recurse)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        if (layers := self.in_bytes()) is not None and takes_bytes(rows):
            return layers.of_rows(rows)
        if not in_one_go(rows):
            return over_tiles(self.forward, rows.split(TILE))
        return self.finish(functional.linear(rows, *self.linear_part()))

    def linear_part(self) -> LinearPart:
        """That of the first layer."""
        return cast(DenseLayer, self[0]).linear_part()

    def finish(self, product: torch.Tensor) -> torch.Tensor:
        """The output, given what the first layer's linear part gives, which is overwritten."""
        if not in_one_go(product):
            return over_tiles(self.finish, product.split(TILE))
        rows = cast(DenseLayer, self[0]).finish(product)
        for layer in list(self)[1:]:
            rows = layer(rows)
        return rows


def output_layer(inputs: int, outputs: int, bias: float = 0.0) -> nn.Linear:
    """A last layer that gives about ``bias`` before it is trained."""
    layer = nn.Linear(inputs, outputs)
    nn.init.normal_(layer.weight, std=0.01)
    nn.init.constant_(layer.bias, bias)
    return layer
