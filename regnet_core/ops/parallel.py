"""Compiled loops over many items, split over the cores that this process may use."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

_limit: int | None = None


def use_cores(count: int) -> None:
    """Use at most so many cores from now on; for processes that share a machine."""
    global _limit
    _limit = count
    _forget()


@cache
def available_cores() -> int:
    """How many cores this process may use."""
    there = _cores_of_the_process()
    return there if _limit is None else min(there, _limit)


def _cores_of_the_process() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(available_cores(), thread_name_prefix="regnet-ops")


def _forget() -> None:
    _pool.cache_clear()
    available_cores.cache_clear()


if hasattr(os, "register_at_fork"):
    # A forked process inherits the pool but not its threads: work given to it would wait for ever.
    os.register_at_fork(after_in_child=_forget)


def for_each_range(kernel: Callable[[int, int], None], count: int, least: int = 256) -> None:
    """Call ``kernel(start, stop)`` for ranges that together cover ``range(count)``.

    The kernels release the GIL and write to disjoint parts of their outputs, so that the result does not depend on how
    many threads there are. Plain threads are used because numba's own thread layers may not be entered from several
    threads at a time, which the callbacks of a ROS executor do.
    """
    pieces = min(available_cores() * 4, max(1, count // least))
    if pieces == 1:
        kernel(0, count)
        return
    bounds = [count * i // pieces for i in range(pieces + 1)]
    for future in [_pool().submit(kernel, bounds[i], bounds[i + 1]) for i in range(pieces)]:
        future.result()
