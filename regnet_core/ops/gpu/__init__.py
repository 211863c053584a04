"""The searches of ``regnet_core.ops`` as kernels for GPUs, which Triton compiles when they first run.

Triton comes with torch for Linux. Where it is missing, and on other devices than NVIDIA's and AMD's GPUs, the
operations do the same in plain torch. Each module here imports Triton and is imported only where it is used.
"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

import torch


def has_kernels(values: torch.Tensor) -> bool:
    """Whether the kernels can work on these values, where they are."""
    return values.device.type == "cuda" and _has_triton()


@cache
def _has_triton() -> bool:
    return find_spec("triton") is not None
