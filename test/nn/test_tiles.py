"""Tiles on several cores: the same result, torch's state as the caller has it, and nothing left changed."""

import threading
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from regnet_core.nn.tiles import TILE, in_one_go, over_tiles
from regnet_core.ops.compiled import compiled
from regnet_core.ops.parallel import for_each_range


@compiled
def note(start, stop, begun):  # type: ignore[no-untyped-def]
    for i in range(start, stop):
        begun[i] = start


PARTS = torch.arange(40.0).reshape(20, 2).split(3)


@pytest.fixture(params=[1, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@torch.no_grad()
def test_parts_are_joined_in_their_order(threads: int) -> None:
    assert torch.equal(over_tiles(lambda part: part * 2.0, iter(PARTS)), torch.arange(40.0).reshape(20, 2) * 2.0)
    assert torch.get_num_threads() == threads


@torch.no_grad()
def test_every_part_has_one_core_and_may_use_compiled_loops(threads: int) -> None:
    def work(part: torch.Tensor) -> torch.Tensor:
        begun = np.empty(1000, np.int64)
        for_each_range(note, len(begun), 1e6, begun)
        return torch.tensor([[torch.get_num_threads(), len(np.unique(begun))]])

    found = over_tiles(work, PARTS)
    assert threads == 1 or torch.equal(found, torch.ones_like(found))


def test_torch_is_in_the_callers_mode(threads: int) -> None:
    def work(part: torch.Tensor) -> torch.Tensor:
        product = part @ torch.ones(2, 2)
        assert not torch.is_grad_enabled() and product.dtype == wanted
        return torch.full((1,), torch.is_inference_mode_enabled())

    wanted = torch.float32
    with torch.no_grad():
        assert not over_tiles(work, PARTS).any()
    wanted = torch.bfloat16
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        assert over_tiles(work, PARTS).all()


@torch.no_grad()
def test_an_error_reaches_the_caller(threads: int) -> None:
    def work(part: torch.Tensor) -> torch.Tensor:
        raise ValueError(f"no tile {part[0, 0]:.0f}")

    with pytest.raises(ValueError, match="no tile"):
        over_tiles(work, PARTS)


@torch.no_grad()
def test_later_threads_have_the_callers_number_of_cores(threads: int) -> None:
    over_tiles(lambda part: part, PARTS)
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert found == [threads]


def test_few_rows_and_rows_with_gradients_go_together() -> None:
    assert in_one_go(torch.zeros(TILE + 1, 1))  # gradients are on
    with torch.no_grad():
        assert in_one_go(torch.zeros(TILE, 1)) and not in_one_go(torch.zeros(TILE + 1, 1))
