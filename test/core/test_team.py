"""Teams of threads: every turn once, whoever does it, awake or asleep; errors; an end."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import pytest

from regnet_core.ops import parallel
from regnet_core.ops.compiled import compiled
from regnet_core.ops.team import Team, shared


class Given(NamedTuple):
    values: np.ndarray
    factor: float


@compiled
def count(start, stop, turns):  # type: ignore[no-untyped-def]
    for i in range(start, stop):
        turns[i] += 1


@compiled
def compute(start, stop, given, shift, flags, out):  # type: ignore[no-untyped-def]
    for i in range(start, stop):
        out[i, 0] = given.values[i] * given.factor + shift[0] if flags[i] else np.float32(shift[1])


@compiled
def refuse(start, stop, values):  # type: ignore[no-untyped-def]
    for i in range(start, stop):
        if values[i] == 77:
            raise ValueError("77 is not a good number")


@pytest.fixture(params=[1, 3])
def team(request: pytest.FixtureRequest) -> Iterator[Team]:
    made = Team(request.param)
    yield made
    made.end()


def wait_until(there: Callable[[], bool]) -> None:
    end = time.monotonic() + 60.0
    while not there():
        assert time.monotonic() < end, "it did not come to this within a minute"
        time.sleep(0.001)


def test_every_turn_is_done_once(team: Team) -> None:
    loop, rng = shared(count), np.random.default_rng(0)
    for _ in range(3000):  # members come late, stay away, or find nothing left
        turns = np.zeros(rng.integers(1, 400), np.int64)
        assert team.run(loop, len(turns), int(rng.integers(1, 12)), int(rng.integers(0, 5)), (turns,))
        assert (turns == 1).all()


def test_members_fall_asleep_and_are_woken(team: Team) -> None:
    loop = shared(count)
    for _ in range(20):
        wait_until(lambda: team.sleeping() == team.members)
        turns = np.zeros(1000, np.int64)
        assert team.run(loop, 1000, 8, team.members, (turns,))
        assert (turns == 1).all()


def test_members_take_a_share(team: Team) -> None:
    turns = np.zeros(1, np.int64)

    def by_members() -> bool:
        team.run(shared(count), 1, 1, team.members, (turns,))
        return team.joined() > 0

    assert team.joined() == 0
    wait_until(by_members)
    before = team.joined()
    team.run(shared(count), 1, 1, 0, (turns,))  # nobody but this thread may
    assert team.joined() == before


def test_loops_get_arrays_tuples_and_numbers(team: Team) -> None:
    given = Given(np.arange(500, dtype=np.float32), 0.5)
    flags, out = np.arange(500) % 3 > 0, np.zeros((500, 2), np.float32)
    assert team.run(shared(compute), 500, 7, team.members, (given, (1.0, 2), flags, out[:, 1:]))
    np.testing.assert_array_equal(out[:, 1], np.where(flags, np.arange(500) * 0.5 + 1.0, 2.0).astype(np.float32))
    assert not out[:, 0].any()


def test_an_error_in_a_loop_is_raised_where_it_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "available_cores", lambda: 2)
    for bad in (0, 500, 999):
        values = np.zeros(1000, np.int64)
        parallel.for_each_range(refuse, 1000, 1e5, values)
        values[bad] = 77
        with pytest.raises(ValueError, match="77 is not a good number"):
            parallel.for_each_range(refuse, 1000, 1e5, values)


def test_an_ended_team_leaves_no_threads() -> None:
    team = Team(2)
    team.run(shared(count), 10, 2, 2, (np.zeros(10, np.int64),))
    team.end()
    assert not any(thread.is_alive() for thread in team.threads)


def test_a_program_ends_while_members_look_out_for_work() -> None:
    script = """
import numpy as np
from regnet_core.ops.buckets import CornerBuckets
from regnet_core.ops.local_planes import local_planes
from regnet_core.ops import parallel
parallel.available_cores = lambda: 3
local_planes(CornerBuckets.of(np.random.default_rng(0).random((5000, 3))), 0.1)
assert parallel._idle
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_what_is_made_of_a_loop_stands_where_the_loop_does() -> None:
    """numba's cache tells functions apart by that."""
    made = [shared(loop).py_func for loop in (count, compute)]
    assert [function.__name__ for function in made] == ["count_shared", "compute_shared"]
    assert made[0].__code__.co_firstlineno < made[1].__code__.co_firstlineno
    assert all(function.__code__.co_filename == __file__ for function in made)
