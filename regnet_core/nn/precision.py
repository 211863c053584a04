"""Which numbers a network computes with: bytes or bf16 where the processor multiplies them faster than fp32."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Literal

import torch

from regnet_core.ops.byte_products import has_byte_products

Precision = Literal["fp32", "bf16", "int8"]

_AMX_BF16, _AVX512_BF16 = "amx_bf16", "avx512_bf16"
_BYTES = {"avx512_vnni", "avx_vnni"}
"""Names of units, in Linux's list of a processor's features."""


@cache
def cpu_precision() -> Precision:
    """What a network detects with on this CPU.

    bf16 with AMX (Intel, from Sapphire Rapids), which is up to 10 times as fast as fp32. Bytes with VNNI (from Ice Lake
    and Zen 4 on): on a Xeon of 2023 whose virtual machine hides AMX they are multiplied 4 to 5 times as fast as fp32,
    and 8 times as fast as bf16 (one core, layers of 256 to 512 channels: 660, 143 and 78 GOP/s).
    """
    processor = _processor()
    if _AMX_BF16 in processor:
        return "bf16"
    if not _BYTES.isdisjoint(processor) and has_byte_products():
        return "int8"
    return "bf16" if has_fast_bf16() else "fp32"


@cache
def has_fast_bf16() -> bool:
    """Whether this CPU multiplies matrices of bf16 faster than those of fp32."""
    return fast_bf16(_processor())


def fast_bf16(processor: frozenset[str]) -> bool:
    """The same of a processor of which Linux says these words in /proc/cpuinfo.

    AMX is made for it, and the AVX-512 of AMD (from Zen 4) is twice as fast as with fp32. Intel's AVX-512 is not made
    for it: without AMX, products of 2048 x 2048 matrices in bf16 took 1.7 times as long as those in fp32 (82 and 141
    GFLOP/s on the Xeon above).
    """
    return _AMX_BF16 in processor or {_AVX512_BF16, "AuthenticAMD"} <= processor


def autocast(device: torch.device) -> torch.autocast:
    """Mixed precision where it pays, for training and for baselines; a context without effect elsewhere."""
    if device.type == "cuda":
        return torch.autocast("cuda", dtype=torch.bfloat16, enabled=torch.cuda.is_bf16_supported())
    return torch.autocast("cpu", dtype=torch.bfloat16, enabled=device.type == "cpu" and has_fast_bf16())


def detecting(device: torch.device, precision: Precision) -> AbstractContextManager[object]:
    """The context in which a network detects on this device with ``cpu_precision``; GPUs have their own."""
    if device.type != "cpu":
        return autocast(device)
    if precision == "int8":
        return _SMALL_STEPS
    return torch.autocast("cpu", dtype=torch.bfloat16) if precision == "bf16" else nullcontext()


class _SmallSteps:
    """What is left to torch between products of bytes is too little to be worth waking its threads for: on two virtual
    cores a detection with ``regnetv2-s`` took 58 ms with one thread of torch and 69 ms with two, beside our own two.

    torch keeps the number for each thread, and new threads begin with what was said last: of several detections at a
    time the first one knows what it was before."""

    def __init__(self) -> None:
        self._lock, self._inside, self._threads = Lock(), 0, 1

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._threads = torch.get_num_threads()
            self._inside += 1
            torch.set_num_threads(1)

    def __exit__(self, *error: object) -> None:
        with self._lock:
            torch.set_num_threads(self._threads)
            self._inside -= 1


_SMALL_STEPS = _SmallSteps()


@cache
def _processor() -> frozenset[str]:
    try:
        return frozenset(Path("/proc/cpuinfo").read_text(encoding="utf-8").split())
    except OSError:
        return frozenset()
