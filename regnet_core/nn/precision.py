"""Which number format the matrix products use: bf16 where the processor has units for it, fp32 elsewhere."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch


@cache
def has_fast_bf16() -> bool:
    """Whether this CPU has AMX units for bf16; without them bf16 is slower than fp32."""
    try:
        return "amx_bf16" in Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False


def autocast(device: torch.device) -> torch.autocast:
    """Mixed precision where it pays; a context without effect elsewhere."""
    if device.type == "cuda":
        return torch.autocast("cuda", dtype=torch.bfloat16, enabled=torch.cuda.is_bf16_supported())
    return torch.autocast("cpu", dtype=torch.bfloat16, enabled=device.type == "cpu" and has_fast_bf16())
