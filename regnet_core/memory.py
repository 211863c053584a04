"""How a process holds on to its memory between two clouds, or between two steps of a training."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
"""Parameters of glibc's mallopt(3)."""
_SETTINGS = ((_MMAP_THRESHOLD, 32 << 20), (_TRIM_THRESHOLD, 1 << 30), (_TOP_PAD, 16 << 20))
"""Larger blocks than 32 MB go back to the system all the same: where they were kept, blocks of ever other sizes left
gaps, and the training of the paper's network grew from 3.5 to 23 GB within 70 steps."""


def keep_freed_memory() -> bool:
    """Ask the C library to keep freed memory for the next arrays; whether it could be asked.

    For programs to call when they start; a library leaves this to them.

    By default most of it goes back to the system, which clears every page before it gives it out again: a third of a
    node's preprocessing, and a fifth of a training step. The process stays as large as it once was.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # another C library, such as musl
        return False
    return all([mallopt(option, value) == 1 for option, value in _SETTINGS])
