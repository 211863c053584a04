"""Memory for training on a CPU."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
"""Parameters of glibc's mallopt(3)."""


def keep_memory() -> bool:
    """Ask the C library not to give freed memory back to the system; whether it could be asked.

    Each step allocates and frees the same large activations. Given back and asked for anew, every page of them is
    cleared by the kernel first: a fifth to a quarter of a step's time. The process stays as large as it once was.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # another C library, such as musl
        return False
    most = 2**31 - 1
    return all([mallopt(_MMAP_THRESHOLD, most), mallopt(_TRIM_THRESHOLD, most), mallopt(_TOP_PAD, 2**28)])
