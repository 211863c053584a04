"""Work on the newest input, several at a time, apart from callbacks."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from live import wait_for

from regnet_ros.workers import Places, Workers


class Gates:
    """Work that lasts until it is told to end, and what came of it."""

    def __init__(self) -> None:
        self.begun: list[int] = []
        self.told: list[int] = []
        self.late: list[float] = []
        self.gates = [threading.Event() for _ in range(10)]
        self.workers: Workers[int] | None = None

    def work(self, item: int) -> None:
        assert self.workers is not None
        self.late.append(self.workers.late(0.1))
        self.begun.append(item)
        self.gates[item].wait(20)
        self.workers.await_turn()
        self.told.append(item)

    def put(self, item: int) -> None:
        """Put an item in and wait until its work has begun."""
        assert self.workers is not None
        self.workers.put(item)
        wait_for(lambda: item in self.begun, f"the work on {item}")


@contextmanager
def running(count: int, pause: float = 0.0) -> Iterator[tuple[Workers[int], Gates]]:
    gates = Gates()
    gates.workers = Workers("test", count, gates.work, lambda _: pause)
    gates.workers.begin()
    yield gates.workers, gates
    for gate in gates.gates:
        gate.set()
    gates.workers.end(20)


def test_work_begins_at_once_where_nothing_asks_for_a_pause_however_long_ago_it_was_allowed() -> None:
    with running(1, -math.inf) as (_, gates):
        gates.put(0)
        assert gates.begun == [0]


def test_nothing_is_taken_while_nothing_is_wanted() -> None:
    with running(1, math.inf) as (workers, gates):
        workers.put(0)
        time.sleep(0.1)
        assert gates.begun == []
        assert workers.wait_until_idle(1.0)


def test_as_many_as_were_asked_for_are_worked_on_at_a_time_and_of_the_others_the_newest() -> None:
    with running(2) as (workers, gates):
        gates.put(0)
        gates.put(1)
        assert not workers.put(2)
        assert workers.put(3)  # in the place of 2
        time.sleep(0.05)
        assert gates.begun == [0, 1]
        gates.gates[0].set()
        wait_for(lambda: 3 in gates.begun, "the work on 3")
        assert gates.begun == [0, 1, 3]


def test_what_was_begun_first_is_told_first() -> None:
    with running(2) as (_, gates):
        gates.put(0)
        gates.put(1)
        gates.gates[1].set()
        time.sleep(0.05)
        assert gates.told == []
        gates.gates[0].set()
        wait_for(lambda: len(gates.told) == 2, "both")
        assert gates.told == [0, 1]


def test_when_the_next_one_is_wanted() -> None:
    """One thread is free when its work ends; several take theirs at a distance of most of an even share."""
    with running(1) as (workers, gates):
        before = time.monotonic()
        gates.put(0)
        assert before + 5.0 <= workers.free_at(5.0) <= time.monotonic() + 5.0
    with running(2) as (workers, gates):
        before = time.monotonic()
        gates.put(0)
        between = time.monotonic()
        assert before + 0.4 * 5.0 <= workers.free_at(5.0) <= between + 0.4 * 5.0
        gates.put(1)
        assert before + 5.0 <= workers.free_at(5.0) <= between + 5.0  # when the first one ends


def test_how_late_an_item_came() -> None:
    with running(1) as (workers, gates):
        gates.put(0)
        time.sleep(0.05)
        workers.put(1)
        time.sleep(0.05)
        gates.gates[0].set()
        wait_for(lambda: 1 in gates.begun, "the work on 1")
        assert gates.late[1] <= -0.04  # it waited
        gates.gates[1].set()
        wait_for(lambda: 1 in gates.told, "the end of 1")
        time.sleep(0.5)
        gates.put(2)
        assert 0.4 <= gates.late[2] <= 5.0


def test_a_stop_waits_for_what_is_being_worked_on() -> None:
    with running(2) as (workers, gates):
        gates.put(0)
        assert not workers.wait_until_idle(0.05)
        stopped = threading.Event()
        thread = threading.Thread(target=workers.stop_for, args=(stopped.set,))
        thread.start()
        assert not stopped.wait(0.1)
        gates.gates[0].set()
        thread.join(20)
        assert stopped.is_set() and gates.told == [0]
        gates.put(1)


def test_places_that_were_taken_in_vain_are_given_back() -> None:
    places = Places(2)
    with places:
        assert not places.take_all(0.01)
    assert places.take_all(0.01)
    assert not places.wait_until_free(0.01)
    places.give_back_all()
    with places, places:
        pass


def test_an_action_that_fails_lets_work_go_on() -> None:
    def fail() -> None:
        raise OSError("the disk is full")

    with running(1) as (workers, gates):
        with pytest.raises(OSError, match="full"):
            workers.stop_for(fail)
        gates.put(0)
