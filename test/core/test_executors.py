"""Where the work of a data set is done: every result once, whatever happens to the workers."""

import os
import signal
import time
from pathlib import Path

import pytest

from regnet_core.data.generation.executors import LocalExecutor, WorkerError
from regnet_core.errors import InvalidInputError


def _square(offset: int, item: int) -> int:
    return item * item + offset


def _die(_: None, item: int) -> int:
    os._exit(1)


def _die_once(folder: str, item: int) -> int:
    """Kills its process at item 3, the first time."""
    mark = Path(folder) / "died"
    if item == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.01)
    return item


def _fail(_: None, item: int) -> int:
    raise ValueError(f"item {item} is bad")


def test_every_result_comes_once() -> None:
    assert sorted(LocalExecutor(2).run(_square, 100, range(20))) == [(i, i * i + 100) for i in range(20)]
    assert list(LocalExecutor(2).run(_square, 100, [])) == []


def test_the_work_of_a_worker_that_died_is_done_again(tmp_path: Path) -> None:
    results = list(LocalExecutor(2).run(_die_once, str(tmp_path), range(12)))
    assert sorted(results) == [(i, i) for i in range(12)]


def test_workers_that_always_die_are_an_error() -> None:
    with pytest.raises(WorkerError, match="died 3 times without a result"):
        list(LocalExecutor(1).run(_die, None, [1]))


def test_an_error_of_the_function_reaches_the_caller() -> None:
    with pytest.raises(ValueError, match="item 4 is bad"):
        list(LocalExecutor(1).run(_fail, None, [4]))


def test_a_negative_number_of_workers_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="workers must be at least 0"):
        LocalExecutor(-1)
