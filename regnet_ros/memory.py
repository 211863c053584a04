"""How a node's process holds on to its memory between two clouds."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

# glibc, <malloc.h>: numbers of the parameters.
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
_SETTINGS = ((_MMAP_THRESHOLD, 32 << 20), (_TRIM_THRESHOLD, 1 << 30), (_TOP_PAD, 16 << 20))
"""32 MB is the largest threshold that glibc accepts."""


def keep_freed_memory() -> bool:
    """Let the C library keep freed blocks of up to 32 MB for the next cloud; whether it agreed (glibc does).

    By default it gives every block of some 100 KB and more, as all arrays of a cloud are, back to the system when it is
    freed, and the system clears each page of the next one: that takes longer than much of the work on them.
    """
    try:
        set_option: Callable[[int, int], int] = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # no glibc
        return False
    return all([set_option(option, value) == 1 for option, value in _SETTINGS])
