"""Threads that work on the newest input of a node, apart from its callbacks."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from regnet_ros.mailbox import Mailbox

_NAP = 0.02
"""Longest sleep of a thread that waits for its turn [s]; a signal is noticed so soon."""
_COURTESY = 0.001
"""Longest time to wait for a thread that has nothing to do to take an item [s]."""
_SPREAD = 0.8
"""With several threads each item is wanted so late after the last one, as a share of what would be an even spread."""

Item = TypeVar("Item")


class Places:
    """So many may do something at a time, each ``with`` a place of its own; or one alone, with all the places."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._free, self._alone = threading.Semaphore(count), threading.Lock()

    def take(self) -> None:
        """Wait for a place."""
        self._free.acquire()

    def give_back(self) -> None:
        """Leave a place to others."""
        self._free.release()

    def __enter__(self) -> None:
        self.take()

    def __exit__(self, *error: object) -> None:
        self.give_back()

    def take_all(self, timeout: float | None = None) -> bool:
        """Wait until nobody has a place, for good or for so long [s], and let nobody in; whether that was reached."""
        end = math.inf if timeout is None else time.monotonic() + timeout
        with self._alone:  # two who each held some would wait for ever
            for taken in range(self.count):
                left = None if timeout is None else max(end - time.monotonic(), 0.0)
                if not self._free.acquire(timeout=left):
                    for _ in range(taken):
                        self._free.release()
                    return False
        return True

    def give_back_all(self) -> None:
        """Let others in again."""
        self._free.release(self.count)

    def wait_until_free(self, timeout: float) -> bool:
        """Wait until nobody has a place, at most so long [s]; whether that was reached."""
        reached = self.take_all(timeout)
        if reached:
            self.give_back_all()
        return reached


class Workers(Generic[Item]):
    """Threads that each take the newest item, when it is its turn, and work on it.

    They are threads of their own and no callbacks: rclpy's executor would first have to be woken, and to look through
    everything that it waits for.
    """

    def __init__(self, name: str, count: int, work: Callable[[Item], None], pause: Callable[[float], float]) -> None:
        """Args:
        name: of the threads.
        count: so many items are worked on at a time, at most.
        work: lets no exception out.
        pause: how long to wait before the next item is taken, from when the last one was [s, monotonic]; infinite: none
            is wanted at all.
        """
        self._name, self._work, self._pause = name, work, pause
        self._mailbox: Mailbox[Item] = Mailbox()
        self._wake, self._ended = threading.Event(), False
        self._taking = threading.Lock()
        """Held while a thread waits for its turn: the others come after it."""
        self._places = Places(count)
        self._taken = threading.Event()
        """Set when an item is taken."""
        self._idle, self._counting = 0, threading.Lock()
        """Threads that wait for something to do."""
        self._threads: list[threading.Thread] = []
        self._last_start = self._since = -math.inf
        self._before = threading.Event()
        """Set at the end of the work that was begun last."""
        self._before.set()
        self._own = threading.local()
        self._starts: dict[int, float] = {}
        """When the items that are being worked on were taken, by thread [s, monotonic]."""

    # -- for who has something to do -------------------------------------------------------------------------------

    def begin(self) -> None:
        """Be there for what comes from now on."""
        self._mailbox.take()  # what came in at the end of an earlier time
        self._since = time.monotonic()
        if not self._threads:
            names = (f"{self._name} {number}" for number in range(self._places.count))
            self._threads = [threading.Thread(target=self._run, name=name, daemon=True) for name in names]
            for thread in self._threads:
                thread.start()

    def put(self, item: Item) -> bool:
        """Have an item worked on; True when it replaced one that nobody had taken.

        A thread that has nothing to do begins first: only one at a time can run Python, and who puts something in often
        has a good deal to do afterwards for which there is time.
        """
        idle = self._idle > 0
        self._taken.clear()
        replaced = self._mailbox.put(item)
        self._wake.set()
        if idle:
            self._taken.wait(_COURTESY)
        return replaced

    def put_if_idle(self, item: Item) -> None:
        """Have an item worked on unless a newer one waits."""
        self._mailbox.put_if_empty(item)
        self._wake.set()  # in any case: where an item waits and nobody works, nobody else would begin

    def forget(self) -> None:
        """Drop what waits."""
        self._mailbox.take()

    def stop_for(self, action: Callable[[], object]) -> None:
        """Do something while nothing is being worked on."""
        self._places.take_all()
        try:
            action()
        finally:
            self._places.give_back_all()

    def wait_until_idle(self, timeout: float) -> bool:
        """Wait until nothing is being worked on or waited for, at most so long [s]; whether that was reached."""
        return self._places.wait_until_free(timeout)

    def end(self, timeout: float) -> None:
        """Work on nothing any more; wait for what is under way, at most so long [s]."""
        self._ended = True
        self._wake.set()
        end = time.monotonic() + timeout
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(end - time.monotonic(), 0.0))

    # -- for the work itself ---------------------------------------------------------------------------------------

    def late(self, usual: float) -> float:
        """How long the item of the thread that asks came after it could have been taken, or, below 0, before [s].

        Args:
            usual: how long work takes [s].
        """
        own = self._own
        return float(own.came - max(own.ended, self._since, self._after(own.last_start, usual)))

    def await_turn(self) -> None:
        """Wait until all work that was begun before has ended, so that what comes of it stays in order."""
        self._own.before.wait()

    def free_at(self, usual: float) -> float:
        """When the next item will be taken, if work takes so long as usual [s]; all times [s, monotonic].

        With several threads that is no sooner than their shares of the usual time after the last one: what they make is
        evenly spread.
        """
        starts = list(self._starts.values())
        free = -math.inf if len(starts) < self._places.count else min(starts) + usual
        return max(free, self._after(self._last_start, usual))

    def _after(self, start: float, usual: float) -> float:
        """The next item is not wanted before this, where the last one was taken at ``start``."""
        return start + _SPREAD * usual / self._places.count

    # -- the threads -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        self._own.ended = -math.inf
        while not self._ended:
            with self._counting:
                self._idle += 1
            self._wake.wait()
            with self._counting:
                self._idle -= 1
            self._wake.clear()
            while (item := self._next()) is not None:
                try:
                    self._work(item)
                finally:
                    self._own.ended = time.monotonic()
                    del self._starts[threading.get_ident()]
                    self._own.done.set()
                    self._places.give_back()
        self._wake.set()  # the others end as well

    def _next(self) -> Item | None:
        """The newest item, when it is its turn, and a place for the work on it; None where there is none, or none is
        wanted."""
        with self._taking:
            self._places.take()
            item = self._mailbox.take() if self._wait_for_turn() else None
            if item is None:
                self._places.give_back()
                return None
            own, now = self._own, time.monotonic()
            own.came, own.last_start = min(self._mailbox.put_at, now), self._last_start
            own.before, own.done = self._before, threading.Event()
            self._before, self._last_start = own.done, now
            self._starts[threading.get_ident()] = now
            self._taken.set()
            return item

    def _wait_for_turn(self) -> bool:
        """Whether an item is wanted, as soon as ``pause`` allows to take one."""
        while not self._ended and (left := self._pause(self._last_start)) < math.inf:
            if left <= 0.0:
                return True
            time.sleep(min(left, _NAP))
        return False
