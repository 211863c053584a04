"""Results that are computed when somebody asks."""

import gc
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import shapes

from regnet_core.later import Later
from regnet_core.report import StepRecorder
from regnet_core.scene import SceneConfig, prepare_scene


def test_a_result_is_computed_once_and_only_when_somebody_asks() -> None:
    numbers = iter([1, 2])
    later = Later(lambda: next(numbers))
    assert next(numbers) == 1
    assert later() == 2 and later() == 2


def test_who_asks_meanwhile_waits_for_the_same_result() -> None:
    begun, go_on = threading.Event(), threading.Event()

    def compute() -> object:
        begun.set()
        assert go_on.wait(30.0)
        return object()

    later = Later(compute)
    with ThreadPoolExecutor(4) as callers:
        first = callers.submit(later)
        assert begun.wait(30.0)
        others = [callers.submit(later) for _ in range(3)]
        assert not any(other.done() for other in others)
        go_on.set()
        assert {id(other.result(30.0)) for other in others} == {id(first.result(30.0))}


def test_a_failure_is_for_everyone_who_asks() -> None:
    divisors = iter([0, 0, 2])
    later = Later(lambda: 14 // next(divisors))
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            later()
    assert later() == 7


def test_what_it_was_computed_from_is_given_back() -> None:
    source = np.zeros(3)
    gone, later = weakref.ref(source), Later(source.sum)
    del source
    assert gone() is not None
    assert later() == 0.0
    assert gone() is None


@pytest.mark.parametrize("asked", [False, True])
def test_scenes_go_without_the_garbage_collector(asked: bool) -> None:
    points = shapes.single_view(shapes.box(0.06, 0.10, 0.12))
    scene = prepare_scene(points, None, SceneConfig(), np.random.default_rng(0), StepRecorder())
    if asked:
        assert scene.ground is not None
    gone = weakref.ref(scene.seen)
    gc.disable()
    try:
        del scene
        assert gone() is None
    finally:
        gc.enable()
