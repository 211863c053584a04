"""Detections in processes of their own: what else a node does, such as receiving clouds, does not hold them up.

Threads of one Python process wait for each other: a detection asks for the interpreter's lock at every step, and
two at a time took half as long again as each in a process of its own, which has its own interpreter. Clouds reach it in
memory that both see. One that was ended, for want of memory for instance, is started again; the next detection there
takes some seconds longer.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import pickle
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from regnet_core.detector import Detection, DetectorConfig, GraspDetector
from regnet_core.errors import InvalidInputError, RegnetError
from regnet_core.filters import GraspFilters
from regnet_core.gripper import Gripper
from regnet_core.memory import keep_freed_memory
from regnet_ros.threads import usable_cores, use_threads

_KEPT = 2
"""A process keeps so many detectors: while another model is made ready, the present one works on."""
_PAGE = mmap.PAGESIZE


class ProcessEndedError(RegnetError):
    """A process ended while it had something to do."""


class Key(NamedTuple):
    """What a detector is made of."""

    model: str
    device: str
    seed: int
    config: DetectorConfig


class _Place(NamedTuple):
    """Where an array is in the memory that two processes see."""

    offset: int
    shape: tuple[int, ...]
    kind: str

    def array(self, memory: mmap.mmap) -> npt.NDArray[Any]:
        return np.frombuffer(memory, self.kind, int(np.prod(self.shape)), self.offset).reshape(self.shape)


class _Room:
    """Memory that two processes see, each by a file descriptor of its own."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._memory: mmap.mmap | None = None

    def put(self, arrays: Sequence[npt.NDArray[Any] | None]) -> list[_Place | None]:
        """Copy arrays into the memory, which grows where they need more than there is."""
        places: list[_Place | None] = []
        end = 0
        for array in arrays:
            places.append(None if array is None else _Place(end, array.shape, array.dtype.str))
            end += 0 if array is None else -(-array.nbytes // _PAGE) * _PAGE
        if end > os.fstat(self._descriptor).st_size:
            os.ftruncate(self._descriptor, end)
        memory = self._seen()
        for array, place in zip(arrays, places, strict=True):
            if array is not None and place is not None and array.size:
                place.array(memory)[...] = array
        return places

    def arrays(self, places: list[_Place | None]) -> list[npt.NDArray[Any] | None]:
        """Arrays that the other process has put there, until it puts others there."""
        return [
            None
            if place is None
            else place.array(self._seen())
            if np.prod(place.shape)
            else np.empty(place.shape, place.kind)
            for place in places
        ]

    def close(self) -> None:
        """Leave the memory; it is gone when both have."""
        self._memory = None
        os.close(self._descriptor)

    def _seen(self) -> mmap.mmap:
        size = max(os.fstat(self._descriptor).st_size, _PAGE)
        if self._memory is None or len(self._memory) < size:
            os.ftruncate(self._descriptor, size)
            self._memory = mmap.mmap(self._descriptor, size)  # arrays of the former one keep it
        return self._memory


# -- in the node's process ---------------------------------------------------------------------------------------------


class _Running(NamedTuple):
    """A process, and the ways to it."""

    program: subprocess.Popen[bytes]
    line: Connection
    room: _Room

    @classmethod
    def start(cls, threads: int) -> _Running:
        """Start one.

        Raises:
            OSError: the system refuses.
        """
        with contextlib.ExitStack() as undo:
            line, other = Pipe()
            undo.callback(line.close)
            descriptor = os.memfd_create("regnet_cloud")
            undo.callback(os.close, descriptor)
            with other:
                numbers = other.fileno(), descriptor
                program = subprocess.Popen(
                    [sys.executable, "-P", "-m", "regnet_ros.detection_process", *map(str, (*numbers, threads))],
                    pass_fds=numbers,
                    process_group=0,  # Ctrl+C is for the node, which ends this process
                    env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
                )
            undo.pop_all()
        return cls(program, line, _Room(descriptor))

    def close(self) -> int:
        """End it, where it has not ended, and leave the ways to it; the exit code."""
        self.program.kill()
        code = self.program.wait()
        self.line.close()
        self.room.close()
        return code


class _Process:
    """A process that is started again where it ended; for one thread at a time, but for ``stop``."""

    def __init__(self, threads: int) -> None:
        self._threads, self._over = threads, False
        self._running: _Running | None = _Running.start(threads)

    def ask(self, task: str, key: Key, *given: Any, arrays: Sequence[npt.NDArray[Any] | None] = ()) -> Any:
        """Have something done there.

        Raises:
            RegnetError: what was raised there.
            RuntimeError: something else was raised there.
            ProcessEndedError: the process ended meanwhile, or cannot be started.
        """
        running = self._alive()
        question = pickle.dumps((task, key, running.room.put(arrays), given))
        try:
            running.line.send_bytes(question)
            done, answer = running.line.recv()
        except (EOFError, OSError) as error:
            raise ProcessEndedError(f"the process that detects was ended: {_how(self._leave())}") from error
        except BaseException:  # an answer that nobody waited for would be taken for that to the next question
            self._leave()
            raise
        if done:
            return answer
        raise answer if isinstance(answer, RegnetError) else RuntimeError(answer)

    def stop(self) -> None:
        """End the process for good; who asks something meanwhile is told so."""
        self._over = True
        if (running := self._running) is not None:
            running.program.kill()

    def close(self) -> None:
        """Leave what is left of it."""
        if self._running is not None:
            self._leave()

    @property
    def number(self) -> int | None:
        """The system's number of the process; None while there is none."""
        return None if self._running is None else self._running.program.pid

    def _alive(self) -> _Running:
        if self._over:
            raise ProcessEndedError("the processes that detect have been ended")
        if self._running is not None and self._running.program.poll() is not None:
            self._leave()  # it ended while it had nothing to do
        if self._running is None:
            try:
                self._running = _Running.start(self._threads)
            except OSError as error:
                raise ProcessEndedError(f"a process that detects cannot be started: {error}") from error
        return self._running

    def _leave(self) -> int:
        running, self._running = self._running, None
        assert running is not None
        code = running.close()
        if not self._over:
            with contextlib.suppress(OSError):  # at once, as it takes seconds; otherwise at the next question
                self._running = _Running.start(self._threads)
        return code


def _how(code: int) -> str:
    names = {number.value: number.name for number in signal.Signals}
    return f"exit code {code}" if code >= 0 else f"signal {names.get(-code, -code)}"


class DetectionProcesses:
    """So many processes that detect, each for one who asks at a time."""

    def __init__(self, count: int, threads: int = 0) -> None:
        """Args:
        count: of processes.
        threads: of all of them together, but one for each at least; 0: one for each core that this process may use.
        """
        share = max((threads or usable_cores()) // count, 1)
        self._all = [_Process(share) for _ in range(count)]
        self._free, self._freed = list(self._all), threading.Condition()

    def detector(self, model: str, device: str, seed: int, config: DetectorConfig) -> RemoteDetector:
        """A detector that works in these processes, once it is ready in all of them, one after the other.

        Raises:
            ModelError: there is no such model or device, or its weights cannot be used.
            ProcessEndedError: a process ended.
        """
        key = Key(model, device, seed, config)
        return RemoteDetector(self, key, *self.ask_each("prepare", key)[0])

    def ask(self, task: str, key: Key, *given: Any, arrays: Sequence[npt.NDArray[Any] | None] = ()) -> Any:
        """Have something done by the next process that has time."""
        with self._taken(self._all) as process:
            return process.ask(task, key, *given, arrays=arrays)

    def ask_each(self, task: str, key: Key, *given: Any, arrays: Sequence[npt.NDArray[Any] | None] = ()) -> list[Any]:
        """Have something done by each process, one after the other: the others have time meanwhile."""
        answers = []
        for one in self._all:
            with self._taken([one]) as process:
                answers.append(process.ask(task, key, *given, arrays=arrays))
        return answers

    @property
    def numbers(self) -> list[int]:
        """The system's numbers of the processes."""
        return [number for process in self._all if (number := process.number) is not None]

    def end(self) -> None:
        """End the processes, also those that are at work."""
        for process in self._all:
            process.stop()
        for process in self._all:
            with self._taken([process]):  # whoever asked has been told by now
                process.close()

    @contextlib.contextmanager
    def _taken(self, those: Sequence[_Process]) -> Iterator[_Process]:
        """One of those, as soon as one has time."""
        with self._freed:
            while not (free := [process for process in self._free if process in those]):
                self._freed.wait()
            self._free.remove(free[0])
        try:
            yield free[0]
        finally:
            with self._freed:
                self._free.append(free[0])
                self._freed.notify_all()


class RemoteDetector:
    """What a ``GraspDetector`` is, in other processes."""

    def __init__(self, processes: DetectionProcesses, key: Key, model: str, device: str) -> None:
        self._processes, self._key = processes, key
        self.model, self.device = model, device

    def detect(
        self,
        points: npt.NDArray[Any],
        gripper: Gripper | None = None,
        colors: npt.NDArray[Any] | None = None,
        *,
        filters: GraspFilters | None = None,
        viewpoint: npt.NDArray[np.float64] | None = None,
    ) -> Detection:
        """As ``GraspDetector.detect`` does it.

        Raises:
            InvalidInputError: as there.
            RuntimeError: something else was raised there.
            ProcessEndedError: the process ended.
        """
        given = gripper, filters, viewpoint
        detection: Detection = self._processes.ask("detect", self._key, *given, arrays=[points, colors])
        return detection

    def warm_up(self, points: npt.NDArray[Any], gripper: Gripper, colors: npt.NDArray[Any]) -> None:
        """Detect in each of the processes, one after the other."""
        self._processes.ask_each("detect", self._key, gripper, None, None, arrays=[points, colors])


# -- in the other one --------------------------------------------------------------------------------------------------


class _Server:
    """Detectors, and what is asked of them."""

    def __init__(self, room: _Room) -> None:
        self._room = room
        self._detectors: dict[Key, GraspDetector] = {}

    def answer(self, task: str, key: Key, places: list[_Place | None], given: tuple[Any, ...]) -> Any:
        detector = self._detectors.pop(key, None) or GraspDetector(*key)
        self._detectors[key] = detector
        while len(self._detectors) > _KEPT:  # those that were asked for longest ago
            del self._detectors[next(iter(self._detectors))]
        if task == "prepare":
            return detector.model, detector.device
        gripper, filters, viewpoint = given
        points, colors = self._room.arrays(places)
        assert points is not None
        return detector.detect(points, gripper, colors, filters=filters, viewpoint=viewpoint)


def serve(line: Connection, room: _Room) -> None:
    """Answer until nobody asks any more."""
    server = _Server(room)
    while True:
        try:
            question = line.recv()
        except (EOFError, OSError):
            return
        try:
            answer = True, server.answer(*question)
        except InvalidInputError as error:
            answer = False, error
        except Exception as error:
            print("".join(traceback.format_exception(error)), file=sys.stderr)
            answer = False, f"{type(error).__name__}: {error}"
        with contextlib.suppress(OSError):
            line.send(answer)  # an error that cannot be sent ends the process


def main() -> int:
    """The program of a process: file descriptors of the line and the room, and the number of threads."""
    line, room, threads = (int(argument) for argument in sys.argv[1:4])
    keep_freed_memory()
    use_threads(threads)
    serve(Connection(line), _Room(room))
    return 0


if __name__ == "__main__":
    sys.exit(main())
