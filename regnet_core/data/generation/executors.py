"""Where the work of a data set is done: in processes here, or as tasks on a Ray cluster.

Both run a function over many items, give the results as they come, and survive the death of a worker: what it was at
is done again.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol, TypeVar

from regnet_core.errors import InvalidInputError, RegnetError
from regnet_core.ops.parallel import available_cores, use_cores

Item = TypeVar("Item")
Result = TypeVar("Result")
_QUEUED = 2
"""Items given out to each worker at a time: enough that none waits."""
_RETRIES = 5
"""How often a task is done again on a cluster after its worker or node died."""
_DEATHS = 3
"""Deaths of workers without a result in between before giving up."""


class WorkerError(RegnetError):
    """Workers die again and again."""


class Executor(Protocol):
    """Runs a function over items."""

    local: bool
    """Whether the work is done on this machine, where the data set's files are."""

    def run(
        self, function: Callable[[Any, Item], Result], shared: Any, items: Sequence[Item]
    ) -> Iterator[tuple[Item, Result]]:
        """Yield (item, function(shared, item)) in any order.

        ``function`` belongs to a module that workers can import; ``shared`` is sent to each of them once.

        Raises:
            WorkerError: workers die again and again.
            Exception: whatever the function raises.
        """
        ...


class LocalExecutor:
    """Processes on this machine, each with one thread; bound to a core where there are as many as cores."""

    local = True

    def __init__(self, workers: int = 0) -> None:
        """Args: number of processes; 0 for as many as there are cores.

        Raises:
            InvalidInputError: the number is negative.
        """
        if workers < 0:
            raise InvalidInputError(f"workers must be at least 0 (0: one for each core), got {workers}")
        self.workers = workers or available_cores()

    def run(
        self, function: Callable[[Any, Item], Result], shared: Any, items: Sequence[Item]
    ) -> Iterator[tuple[Item, Result]]:
        left = dict.fromkeys(items)
        deaths = 0
        while left:
            try:
                for item, result in self._run_once(function, shared, list(left)):
                    del left[item]
                    deaths = 0
                    yield item, result
            except BrokenProcessPool as error:
                deaths += 1
                if deaths >= _DEATHS:
                    raise WorkerError(
                        f"a worker died {deaths} times without a result; is there memory for {self.workers} workers?"
                    ) from error

    def _run_once(
        self, function: Callable[[Any, Item], Result], shared: Any, items: Sequence[Item]
    ) -> Iterator[tuple[Item, Result]]:
        # Not forked: the parent may have threads (of Open3D, of the progress bar), which a fork would leave behind.
        context = multiprocessing.get_context("spawn")
        turn = context.Value("i", 0) if self.workers >= available_cores() else None
        pool = ProcessPoolExecutor(self.workers, context, _start_worker, (turn, function, shared))
        try:
            yield from _in_flight(lambda item: pool.submit(_work, item), items, self.workers * _QUEUED)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _in_flight(
    submit: Callable[[Item], Future[Result]], items: Iterable[Item], at_once: int
) -> Iterator[tuple[Item, Result]]:
    """Keep so many items in the works and yield what is done."""
    waiting: dict[Future[Result], Item] = {}
    for item in items:
        waiting[submit(item)] = item
        if len(waiting) >= at_once:
            yield from _done(waiting)
    while waiting:
        yield from _done(waiting)


def _done(waiting: dict[Future[Result], Item]) -> Iterator[tuple[Item, Result]]:
    finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
    for future in finished:
        item = waiting.pop(future)
        yield item, future.result()


_job: tuple[Callable[[Any, Any], Any], Any] | None = None
"""In a worker: the function and what goes along with it."""


def _start_worker(turn: Any, function: Callable[[Any, Any], Any], shared: Any) -> None:
    global _job
    _job = function, shared
    use_cores(1)
    if turn is not None and hasattr(os, "sched_setaffinity"):
        # One core for each: the threads of the libraries would only get in each other's way.
        with turn.get_lock():
            number = turn.value
            turn.value += 1
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[number % len(cores)]})
    # Ctrl-C reaches the whole group; the parent alone decides what becomes of the work.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this worker when its parent is gone: a killed parent cannot tell it."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _work(item: Any) -> Any:
    assert _job is not None
    function, shared = _job
    return function(shared, item)


class RayExecutor:
    """Tasks on a Ray cluster; those of a node that dies are run elsewhere, and nodes that join get work."""

    local = False

    def __init__(self, address: str) -> None:
        """Args: the cluster's address as `ray.init` takes it: host:port, ray://host:port, auto, or local.

        Raises:
            InvalidInputError: Ray is not installed, or there is no cluster at that address.
        """
        try:
            import ray
        except ImportError as error:
            raise InvalidInputError("Ray is not installed; pip install 'regnet_ros[cluster]' brings it") from error
        self._ray = ray
        if not ray.is_initialized():
            _probe(address)
            try:
                ray.init(address=address, log_to_driver=False, configure_logging=False)
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise InvalidInputError(f"no Ray cluster answers at {address!r}: {error}") from error

    @property
    def workers(self) -> int:
        """CPUs of the cluster now."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def run(
        self, function: Callable[[Any, Item], Result], shared: Any, items: Sequence[Item]
    ) -> Iterator[tuple[Item, Result]]:
        ray = self._ray
        task = ray.remote(num_cpus=1, max_retries=_RETRIES)(_on_one_core)
        reference = ray.put(shared)
        waiting: dict[Any, Item] = {}
        queue = iter(items)
        while True:
            while len(waiting) < self.workers * _QUEUED and (item := next(queue, None)) is not None:
                waiting[task.remote(function, reference, item)] = item
            if not waiting:
                return
            for done in ray.wait(list(waiting), num_returns=1)[0]:
                try:
                    result = ray.get(done)
                except ray.exceptions.RayTaskError as error:
                    raise error.as_instanceof_cause() from None
                except ray.exceptions.RayError as error:
                    raise WorkerError(f"a task failed {_RETRIES + 1} times on the cluster: {error}") from error
                yield waiting.pop(done), result


def _on_one_core(function: Callable[[Any, Item], Result], shared: Any, item: Item) -> Result:
    """A task has one core of its node: the kernels' threads would take all."""
    use_cores(1)
    return function(shared, item)


def _probe(address: str) -> None:
    """Refuse an address host:port at which nothing listens; Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdigit()):
        return
    try:
        socket.create_connection((host, int(port)), timeout=5.0).close()
    except (OSError, OverflowError) as error:
        raise InvalidInputError(f"no Ray cluster answers at {address!r}: {error}") from error
