"""Rows that go through layers in tiles, each on a core of its own, when nothing is kept for gradients.

What a tile becomes on its way stays in the core's cache, in memory that need not be asked for anew, and the cores meet
once, at the end, instead of after every product.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from threading import Barrier, Lock
from typing import NamedTuple, TypeVar

import torch

from regnet_core.ops.parallel import forget_at_fork, on_one_core

_making = Lock()
TILE = 4096
"""Rows of a tile: few enough for the cache, enough for the products to be as fast as they get."""
Part = TypeVar("Part")


def in_one_go(rows: torch.Tensor) -> bool:
    """Whether rows (n, ...) should go through the layers together: few ones, those of a GPU, and with gradients."""
    return len(rows) <= TILE or torch.is_grad_enabled() or rows.device.type != "cpu"


def tiles(rows: int, size: int = TILE) -> list[slice]:
    """So many rows in tiles; at least one, which may be empty."""
    return [slice(start, min(start + size, rows)) for start in range(0, max(rows, 1), size)]


def over_tiles(work: Callable[[Part], torch.Tensor], parts: Iterable[Part]) -> torch.Tensor:
    """``torch.cat([work(part) for part in parts])``, several at a time; the result does not depend on how many."""
    cores = torch.get_num_threads()
    if cores == 1:
        return torch.cat([work(part) for part in parts])
    mode = _Mode.current()

    def run(part: Part) -> torch.Tensor:
        with mode.again(), on_one_core():
            return work(part)

    return torch.cat(list(_pool(cores).map(run, parts)))


class _Mode(NamedTuple):
    """What torch keeps for each thread and work on a tile must have from its caller."""

    inference: bool
    autocast: bool
    dtype: torch.dtype

    @classmethod
    def current(cls) -> _Mode:
        return cls(torch.is_inference_mode_enabled(), torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu"))

    @contextmanager
    def again(self) -> Iterator[None]:
        with torch.inference_mode(self.inference), torch.no_grad(), torch.autocast("cpu", self.dtype, self.autocast):
            yield


def _pool(cores: int) -> ThreadPoolExecutor:
    with _making:  # one for all who ask at a time
        return _made_pool(cores)


@cache
def _made_pool(cores: int) -> ThreadPoolExecutor:
    """Threads in each of which torch uses one core.

    ``torch.set_num_threads`` speaks for its own thread and for those that are yet to come: hence the last line. What
    was said for a thread reaches it when it first asks or computes: hence the first line of each.
    """
    ready = Barrier(cores)

    def begin() -> None:
        torch.get_num_threads()
        torch.set_num_threads(1)
        ready.wait()

    pool = ThreadPoolExecutor(cores, "regnet-tiles", begin)
    list(pool.map(lambda _: None, range(cores)))
    torch.set_num_threads(cores)
    return pool


forget_at_fork(_made_pool.cache_clear)
