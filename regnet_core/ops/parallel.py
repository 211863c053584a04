"""Compiled loops over many items, split over the cores that this process may use."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock, local

from regnet_core.ops.team import Team, can_have_teams, shared

_WORTH = 10_000
"""A piece of work that takes so long is worth a core's while [ns]: members of a team are at it within two microseconds
where they have just had something to do."""
_limit: int | None = None
_thread = local()
"""What is said of the thread that asks."""
_under_way, _counting = 0, Lock()
"""How many computations share the cores now."""
_idle: list[Team] = []
"""Teams that have nothing to do."""


def use_cores(count: int) -> None:
    """Use at most so many cores from now on; for processes that share a machine."""
    global _limit
    _limit = count
    while _idle:
        _idle.pop().end()
    _forget()


@cache
def available_cores() -> int:
    """How many cores this process may use."""
    there = _cores_of_the_process()
    return there if _limit is None else min(there, _limit)


def _cores_of_the_process() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _forget() -> None:
    _idle.clear()
    available_cores.cache_clear()


def _nothing_under_way() -> None:
    global _under_way, _counting
    _under_way, _counting = 0, Lock()


def forget_at_fork(forget: Callable[[], None]) -> None:
    """Call this in every forked process: it inherits a pool or a team but not its threads."""
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
    they get more done than one after the other, as hardly any work can be split without loss. Other threads take what
    is left."""
    global _under_way
    inside = getattr(_thread, "inside", 0)
    with _counting:
        _under_way += 1
    _thread.inside = inside + 1
    try:
        yield
    finally:
        _thread.inside = inside
        with _counting:
            _under_way -= 1


def _own_cores() -> int:
    """How many cores the thread that asks may use now."""
    if getattr(_thread, "alone", False):
        return 1
    if getattr(_thread, "inside", 0):
        return max(available_cores() // max(_under_way, 1), 1)
    return max(available_cores() - max(_under_way, 0), 1)


def for_each_range(loop: Callable[..., None], count: int, each: float, *arguments: object) -> None:
    """Do all turns of a compiled loop: ``loop(start, stop, *arguments)`` for ranges that together cover
    ``range(count)``, on the cores that this thread may use.

    Args:
        loop: what ``compiled`` has made.
        count: of turns.
        each: about how long a turn takes on one core [ns].
        arguments: what numba can hand over; ranges write to disjoint parts of them, so that the result does not depend
            on how many threads there are.

    Raises:
        RuntimeError: a range failed, and the loop as a whole, done again, did not.
    """
    cores = _own_cores()
    pieces = min(cores * 4, count, int(count * each / _WORTH))
    if pieces <= 1 or cores == 1 or not can_have_teams():
        loop(0, count, *arguments)
        return
    team = _take_team()
    try:
        done = team.run(_shared(loop), count, pieces, cores - 1, arguments)
    finally:
        if team.members == available_cores() - 1:
            _idle.append(team)
        else:  # use_cores was called meanwhile
            team.end()
    if not done:
        loop(0, count, *arguments)  # raises what was raised in a thread that nobody asks
        raise RuntimeError(f"a range of the loop {loop.__name__} failed")


def _take_team() -> Team:
    try:
        return _idle.pop()
    except IndexError:
        return Team(available_cores() - 1)


_shared = cache(shared)
