"""Compiled loops over many items, split over the cores that this process may use."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from threading import Lock, local
from typing import TypeVar

_WORTH = 300_000
"""A piece of work that takes so long is worth waking a thread for [ns]: that takes a tenth of a millisecond on virtual
machines, and two cores that share their units work at two thirds of their speed each."""
Result = TypeVar("Result")
_limit: int | None = None
_thread = local()
"""What is said of the thread that asks."""
_under_way, _counting = 0, Lock()
"""How many computations share the cores now."""


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


def _nothing_under_way() -> None:
    global _under_way, _counting
    _under_way, _counting = 0, Lock()


def forget_at_fork(forget: Callable[[], None]) -> None:
    """Call this in every forked process: it inherits a pool but not its threads, and work given to it would wait for
    ever."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=forget)


forget_at_fork(_forget)
forget_at_fork(_nothing_under_way)


@contextmanager
def on_one_core() -> Iterator[None]:
    """Within this context loops of this thread use its own core alone, as the others have work already."""
    _thread.alone = True
    try:
        yield
    finally:
        _thread.alone = False


@contextmanager
def sharing_cores() -> Iterator[None]:
    """Of several computations of this process within this context, each keeps to its share of the cores: side by side
    they get more done than one after the other, as hardly any work can be split without loss."""
    global _under_way
    with _counting:
        _under_way += 1
    try:
        yield
    finally:
        with _counting:
            _under_way -= 1


def _own_cores() -> int:
    """How many cores the thread that asks may use now."""
    if getattr(_thread, "alone", False):
        return 1
    return max(available_cores() // max(_under_way, 1), 1)


def for_each_range(kernel: Callable[[int, int], None], count: int, each: float) -> None:
    """Call ``kernel(start, stop)`` for ranges that together cover ``range(count)``.

    Args:
        kernel: a compiled loop.
        count: of items.
        each: about how long an item takes on one core [ns]; what is done sooner than others can be asked is not split.

    The kernels release the GIL and write to disjoint parts of their outputs, so that the result does not depend on how
    many threads there are. Plain threads are used because numba's own thread layers may not be entered from several
    threads at a time, which the callbacks of a ROS executor do. The caller works too: to wake a thread that sleeps
    takes about as long as a small piece of the work.
    """
    cores = _own_cores()
    pieces = min(cores * 4, count, int(count * each / _WORTH))
    if pieces <= 1 or cores == 1:
        kernel(0, count)
        return
    bounds = [count * i // pieces for i in range(pieces + 1)]
    left = iter(range(pieces))  # shared: each number is given out once

    def work() -> None:
        for i in left:
            kernel(bounds[i], bounds[i + 1])

    helpers = [_pool().submit(work) for _ in range(min(cores, pieces) - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            if not helper.cancel():  # one that has not begun is not needed any more
                helper.result()


def beside(work: Callable[[], Result]) -> Callable[[], Result]:
    """Have work done on another core from now on -> what waits for it and gives its result, or raises its error, each
    time that it is called. Where there is one core for this thread, the work is done at once, and an error raised at
    once.
    """
    if _own_cores() == 1:
        done = work()
        return lambda: done

    return _pool().submit(work).result
