"""How many threads the computations of a node use."""

from __future__ import annotations

import os
from pathlib import Path

from regnet_core.ops.parallel import available_cores, use_cores

_QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""Microseconds of computing time in each period, or "max", and the period: how containers are limited."""


def use_threads(count: int = 0) -> None:
    """Let detections use so many threads; call it before torch is loaded.

    Args:
        count: 0: one for each core that the process may use, for torch OMP_NUM_THREADS where that is set.
    """
    threads = count or usable_cores()
    use_cores(threads)
    if count > 0:
        os.environ["OMP_NUM_THREADS"] = str(count)
    else:
        os.environ.setdefault("OMP_NUM_THREADS", str(threads))


def usable_cores(quota: Path = _QUOTA) -> int:
    """The cores that this process may use, by its affinity and by the quota of its container."""
    try:
        time, period = quota.read_text(encoding="ascii").split()
        limit = max(1, int(time) // int(period))
    except (OSError, ValueError):
        return available_cores()
    return min(available_cores(), limit)
