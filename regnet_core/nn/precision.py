"""Which number format the matrix products use: bf16 where the processor has units for it, fp32 elsewhere."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch

_UNITS = {"amx_bf16", "avx512_bf16"}
"""Names, in Linux's list of a processor's features, of units that multiply bf16: up to 10 times faster than fp32 with
AMX (Intel, from Sapphire Rapids), 5 times with AVX-512 (AMD, from Zen 4)."""


@cache
def has_fast_bf16() -> bool:
    """Whether this CPU multiplies matrices of bf16 in hardware; where it does not, bf16 is slower than fp32."""
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8").split()
    except OSError:
        return False
    return not _UNITS.isdisjoint(flags)


def autocast(device: torch.device) -> torch.autocast:
    """Mixed precision where it pays; a context without effect elsewhere."""
    if device.type == "cuda":
        return torch.autocast("cuda", dtype=torch.bfloat16, enabled=torch.cuda.is_bf16_supported())
    return torch.autocast("cpu", dtype=torch.bfloat16, enabled=device.type == "cpu" and has_fast_bf16())
