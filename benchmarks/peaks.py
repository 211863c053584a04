"""What the machine can do at best: matrix products in fp32 and bf16, and memory traffic, by torch; products of bytes by
ours, as the network does.

A peak is the best of many short trials: it is the measure that stages are held against, and must not depend on what
else the machine does meanwhile. Whatever the processor lacks units for is measured just the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from benchmarks.machine import last_level_cache
from regnet_core.nn.int8 import rounded
from regnet_core.ops.byte_products import has_byte_products
from regnet_core.ops.bytes import Layers, floats_of_rows

_SIDE = 2048
"""Of the square matrices: large enough that starting and packing do not count, small enough for a trial to be short."""
_LAYERS = 4
"""Of bytes: only what the last one gives is written to memory."""
_LEAST_ARRAY, _MOST_ARRAY = 64 << 20, 512 << 20
_TRIAL = 0.1
"""Products are repeated for so long [s]."""


@dataclass(frozen=True)
class PeakSample:
    """One trial of everything."""

    fp32: float
    """Matrix product [FLOP/s], 2 for each multiply-add."""
    bf16: float
    """[FLOP/s]"""
    copy: float
    """Memory traffic of a = b [bytes/s], read and written."""
    triad: float
    """That of a = b + s c [bytes/s], as STREAM counts it."""
    int8: float
    """Matrix product of bytes [operations/s], 2 for each multiply-add; 0 where the processor has none."""


class PeakMeter:
    """Matrices and arrays to measure with."""

    def __init__(self, side: int = _SIDE, array_bytes: int | None = None) -> None:
        """Args:
        side: of the matrices.
        array_bytes: size of each array; four times the last-level cache when not given.
        """
        size = array_bytes or min(max(_LEAST_ARRAY, 4 * last_level_cache()), _MOST_ARRAY)
        generator = torch.Generator().manual_seed(0)
        self._matrices = [torch.rand(side, side, generator=generator) - 0.5 for _ in range(3)]
        self._half = [matrix.bfloat16() for matrix in self._matrices]
        self._rows = self._matrices[1] + 0.5
        self._layer = Layers.of([rounded(self._matrices[2])] * _LAYERS, to_floats=True) if has_byte_products() else None
        self._arrays = [torch.ones(size // 4) for _ in range(3)]

    @torch.inference_mode()
    def measure(self) -> PeakSample:
        """One trial."""
        a, b, c = self._arrays
        nbytes = a.numel() * a.element_size()
        return PeakSample(
            fp32=self._product(self._matrices),
            bf16=self._product(self._half),
            copy=2 * nbytes / _fastest(lambda: a.copy_(b)),
            triad=3 * nbytes / _fastest(lambda: torch.add(b, c, alpha=3.0, out=a)),
            int8=self._byte_product(),
        )

    def _product(self, matrices: list[torch.Tensor]) -> float:
        out, left, right = matrices
        return float(2 * len(out) ** 3 / _fastest(lambda: torch.mm(left, right, out=out)))

    def _byte_product(self) -> float:
        rows, layer = self._rows, self._layer
        if layer is None:
            return 0.0
        return 2 * _LAYERS * len(rows) ** 3 / _fastest(lambda: floats_of_rows(rows, layer, len(rows), rectified=True))


def _fastest(work: Callable[[], object]) -> float:
    """The least time of some calls in a row [s], the first of which only warms up."""
    work()
    best, end = float("inf"), time.perf_counter() + _TRIAL
    while True:
        start = time.perf_counter()
        work()
        now = time.perf_counter()
        best = min(best, now - start)
        if now >= end:
            return best
