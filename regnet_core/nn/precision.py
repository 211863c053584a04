"""Which number format the matrix products use: bf16 where the processor multiplies it faster than fp32, else fp32."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch

_AMX, _AVX512 = "amx_bf16", "avx512_bf16"
"""Names of units that multiply bf16, in Linux's list of a processor's features."""


@cache
def has_fast_bf16() -> bool:
    """Whether this CPU multiplies matrices of bf16 faster than those of fp32."""
    try:
        return fast_bf16(Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except OSError:
        return False


def fast_bf16(processor: str) -> bool:
    """The same of a processor of which Linux says this in /proc/cpuinfo.

    AMX (Intel, from Sapphire Rapids) is up to 10 times as fast as fp32, AVX-512 of AMD (from Zen 4) is twice as fast.
    Intel's AVX-512 is not made for it: without AMX, which virtual machines may hide, products of 2048 x 2048 matrices
    in bf16 took 1.7 times as long as those in fp32 (Xeon of 2023, one core: 82 and 141 GFLOP/s).
    """
    words = processor.split()
    return _AMX in words or (_AVX512 in words and "AuthenticAMD" in words)


def autocast(device: torch.device) -> torch.autocast:
    """Mixed precision where it pays; a context without effect elsewhere."""
    if device.type == "cuda":
        return torch.autocast("cuda", dtype=torch.bfloat16, enabled=torch.cuda.is_bf16_supported())
    return torch.autocast("cpu", dtype=torch.bfloat16, enabled=device.type == "cpu" and has_fast_bf16())
