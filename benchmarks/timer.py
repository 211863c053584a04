"""Times of stages by wrappers around the functions that do their work.

Every stage gets the time of its own functions less that of the stages called from them, so that the stages of a
detection add up to it. Wrapping costs about a microsecond a call; what is reported as a total is measured without.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from benchmarks.errors import StageError
from benchmarks.patching import Function, Target, replace, resolve
from benchmarks.stage import Stage

Observer = Callable[[tuple[Any, ...], Any], Mapping[str, float]]
"""From the arguments and the result of a call to numbers worth knowing, such as how many neighbours it found."""


@dataclass
class StageTime:
    """What one stage took in one sample."""

    calls: int = 0
    wall: float = 0.0
    """Without the stages inside [s]."""
    cpu: float = 0.0
    """Of all threads of the process, without the stages inside [s]."""
    inclusive: float = 0.0
    """With the stages inside [s]."""


@dataclass
class Sample:
    """What was seen since the timer was reset."""

    stages: dict[str, StageTime] = field(default_factory=dict)
    counts: dict[str, float] = field(default_factory=dict)
    """Sums of what the observers found."""


class _Frame:
    """A stage that is running."""

    __slots__ = ("cpu", "inner_cpu", "inner_wall", "name", "wall")

    def __init__(self, name: str) -> None:
        self.name, self.inner_wall, self.inner_cpu = name, 0.0, 0.0
        self.cpu, self.wall = time.process_time(), time.perf_counter()


class StageTimer:
    """Measures stages while it is entered.

    Args:
        stages: which.
        levels: of the network's hierarchy, for stages that are counted downwards.
        observers: by target, what else to note of each call.

    Raises:
        StageError: a function that a stage names does not exist (any more).
    """

    def __init__(
        self, stages: Sequence[Stage], levels: int = 0, observers: Mapping[str, Observer] | None = None
    ) -> None:
        self._levels = levels
        self._observers = dict(observers or {})
        self._targets: list[tuple[Stage, str, Target]] = []
        for stage in stages:
            for name in stage.targets:
                self._targets.append((stage, name, resolve(name)))
        unknown = set(self._observers) - {name for _, name, _ in self._targets}
        if unknown:
            raise StageError(f"what is observed must be the target of a stage, which {sorted(unknown)[0]} is not")
        self._stack: ExitStack | None = None
        self._running = threading.local()
        self._lock = threading.Lock()
        self._sample, self._numbers = Sample(), dict[str, int]()

    def __enter__(self) -> StageTimer:
        self._stack = ExitStack()
        for stage, name, target in self._targets:
            replace(self._stack, target, self._wrapped(stage, name, target.function))
        return self

    def __exit__(self, *_: object) -> None:
        assert self._stack is not None
        self._stack.close()

    def take(self) -> Sample:
        """The sample so far; a new one begins."""
        with self._lock:
            sample, self._sample, self._numbers = self._sample, Sample(), {}
        return sample

    def _wrapped(self, stage: Stage, target: str, function: Function) -> Function:
        observe = self._observers.get(target)

        @functools.wraps(function)
        def timed(*arguments: Any, **named: Any) -> Any:
            frames = self._frames()
            frame = _Frame(self._name(stage))
            frames.append(frame)
            try:
                result = function(*arguments, **named)
            finally:
                frames.pop()
                self._ended(frame, frames)
            if observe is not None:
                self._note(target, observe, arguments, result)
            return result

        return timed

    def _frames(self) -> list[_Frame]:
        frames: list[_Frame] | None = getattr(self._running, "frames", None)
        if frames is None:
            frames = self._running.frames = []
        return frames

    def _name(self, stage: Stage) -> str:
        if not stage.numbered:
            return stage.name
        with self._lock:
            number = self._numbers[stage.name] = self._numbers.get(stage.name, 0) + 1
        return stage.numbered_name(number if stage.numbered == "up" else max(self._levels + 1 - number, 1))

    def _ended(self, frame: _Frame, outer: Sequence[_Frame]) -> None:
        wall, cpu = time.perf_counter() - frame.wall, time.process_time() - frame.cpu
        if outer:
            outer[-1].inner_wall += wall
            outer[-1].inner_cpu += cpu
        again = any(other.name == frame.name for other in outer)
        with self._lock:
            entry = self._sample.stages.setdefault(frame.name, StageTime())
            entry.calls += 1
            entry.wall += wall - frame.inner_wall
            entry.cpu += cpu - frame.inner_cpu
            entry.inclusive += 0.0 if again else wall

    def _note(self, target: str, observe: Observer, arguments: tuple[Any, ...], result: Any) -> None:
        try:
            found = observe(arguments, result)
        except (AttributeError, IndexError, TypeError) as error:
            raise StageError(f"{target} takes or gives something else than the benchmarks know: {error}") from error
        with self._lock:
            for name, value in found.items():
                self._sample.counts[name] = self._sample.counts.get(name, 0.0) + value
