"""The process that measures: `python -m benchmarks.worker KIND`, with requests and answers as lines of JSON.

The first line on standard input is how the task is made, with the number of threads; every other one asks for a
measurement. What libraries print goes to standard error. The process ends with its input.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from typing import IO, Any, Protocol

from regnet_core.errors import RegnetError


class Task(Protocol):
    """One kind of measurement."""

    def facts(self) -> dict[str, Any]:
        """What the parent wants to know ahead."""
        ...

    def measure(self, *arguments: Any, **named: Any) -> dict[str, Any]:
        """One measurement."""
        ...


def make_task(kind: str, settings: dict[str, Any]) -> Any:
    """A task; what it needs is imported here, after the number of threads is set."""
    return _KINDS[kind](settings)


def _detection(settings: dict[str, Any]) -> Any:
    from benchmarks.tasks.detection import DetectionTask

    return DetectionTask(**settings)


def _memory(settings: dict[str, Any]) -> Any:
    from benchmarks.tasks.memory import MemoryTask

    return MemoryTask(**settings)


def _peaks(settings: dict[str, Any]) -> Any:
    from benchmarks.tasks.peaks import PeakTask

    return PeakTask(**settings)


def _reference(settings: dict[str, Any]) -> Any:
    from benchmarks.tasks.reference import ReferenceTask

    return ReferenceTask(**settings)


def _publisher(settings: dict[str, Any]) -> Any:
    from benchmarks.ros.publisher import PublisherTask

    return PublisherTask(**settings)


def _receiver(settings: dict[str, Any]) -> Any:
    from benchmarks.ros.receiver import ReceiverTask

    return ReceiverTask(**settings)


_KINDS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "detection": _detection,
    "memory": _memory,
    "peaks": _peaks,
    "reference": _reference,
    "publisher": _publisher,
    "receiver": _receiver,
}


def serve(kind: str, requests: IO[str], answers: IO[str]) -> None:
    """Answer requests until there are no more."""

    def answer(work: Callable[[], dict[str, Any]]) -> bool:
        try:
            reply = {"result": work()}
        except RegnetError as error:
            reply = {"error": {"message": str(error), "kind": type(error).__name__}}
        answers.write(json.dumps(reply) + "\n")
        answers.flush()
        return "result" in reply

    settings = json.loads(requests.readline())
    _start_as_a_node(settings.pop("threads"))
    made: list[Any] = []

    def begin() -> dict[str, Any]:
        made.append(make_task(kind, settings))
        return dict(made[0].facts())

    if not answer(begin):
        return
    for line in requests:
        arguments = json.loads(line)
        method = getattr(made[0], arguments.pop("method", "measure"))
        answer(lambda m=method, a=arguments: dict(m(**a)))  # type: ignore[misc]


def _start_as_a_node(count: int) -> None:
    """As the detector node does it with its parameter ``threads``, and with its memory."""
    from regnet_core.memory import keep_freed_memory
    from regnet_ros.threads import use_threads

    keep_freed_memory()
    use_threads(count)


def main() -> None:
    """Serve on the standard streams."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    serve(sys.argv[1], sys.stdin, answers)


if __name__ == "__main__":
    main()
