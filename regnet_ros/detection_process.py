"""Detections in processes of their own: what else a node does, such as receiving clouds, does not hold them up.

Threads of one Python process wait for each other: a detection asks for the interpreter's lock a thousand times, and
two at a time took half as long again as each in a process of its own, which has its own interpreter. Clouds reach it in
memory that both see. It is started again where it was ended, for want of memory for instance.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import queue
import signal
import subprocess
import sys
import traceback
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
_LAST_WORK = 2.0
"""How long to wait for a process to end by itself [s]."""


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

    def put(self, arrays: list[npt.NDArray[Any] | None]) -> list[_Place | None]:
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
            None if place is None else place.array(self._seen()) if np.prod(place.shape) else np.empty(place.shape)
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


class _Process:
    """One process; one question at a time."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._start()

    def ask(self, task: str, key: Key, *given: Any) -> Any:
        """Have something done there.

        Raises:
            RegnetError: what was raised there.
            RuntimeError: something else was raised there.
            ProcessEndedError: the process ended; another one takes its place.
        """
        try:
            self._line.send((task, key, given))
            done, answer = self._line.recv()
        except (EOFError, OSError) as error:
            self._program.wait()
            code = self._program.returncode
            self._leave()
            self._start()
            raise ProcessEndedError(
                f"the process that detects was ended ({_how(code)}); it is started again, and the node goes on with "
                "the next input"
            ) from error
        if done:
            return answer
        raise answer if isinstance(answer, RegnetError) else RuntimeError(answer)

    def put(self, arrays: list[npt.NDArray[Any] | None]) -> list[_Place | None]:
        """Arrays for the next question."""
        return self._room.put(arrays)

    def end(self) -> None:
        """End the process."""
        self._leave()
        try:
            self._program.wait(_LAST_WORK)
        except subprocess.TimeoutExpired:
            self._program.kill()
            self._program.wait()

    @property
    def number(self) -> int:
        """The system's number of the process."""
        return self._program.pid

    def _start(self) -> None:
        self._line, other = Pipe()
        descriptor = os.memfd_create("regnet_cloud")
        self._room = _Room(descriptor)
        arguments = [str(number) for number in (other.fileno(), descriptor, self._threads)]
        paths = [path for path in sys.path if path]
        self._program = subprocess.Popen(
            [sys.executable, "-m", "regnet_ros.detection_process", *arguments],
            pass_fds=[other.fileno(), descriptor],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        )
        other.close()

    def _leave(self) -> None:
        self._line.close()
        self._room.close()


def _how(code: int) -> str:
    return f"exit code {code}" if code >= 0 else f"signal {signal.Signals(-code).name}"


class DetectionProcesses:
    """So many processes that detect, each for one who asks at a time."""

    def __init__(self, count: int, threads: int = 0) -> None:
        """Args:
        count: of processes.
        threads: of all of them together; 0: one for each core that this process may use.
        """
        share = max((threads or usable_cores()) // count, 1)
        self._all = [_Process(share) for _ in range(count)]
        self._free: queue.SimpleQueue[_Process] = queue.SimpleQueue()
        for process in self._all:
            self._free.put(process)

    def detector(self, model: str, device: str, seed: int, config: DetectorConfig) -> RemoteDetector:
        """A detector that works in these processes.

        Raises:
            ModelError: there is no such model or device, or its weights cannot be used.
            ProcessEndedError: the process ended.
        """
        key = Key(model, device, seed, config)
        return RemoteDetector(self, key, *self.ask("prepare", key))

    def ask(self, task: str, key: Key, *given: Any, arrays: list[npt.NDArray[Any] | None] | None = None) -> Any:
        """Have something done by the next process that has time."""
        process = self._free.get()
        try:
            places = [] if arrays is None else [process.put(arrays)]
            return process.ask(task, key, *places, *given)
        finally:
            self._free.put(process)

    @property
    def numbers(self) -> list[int]:
        """The system's numbers of the processes."""
        return [process.number for process in self._all]

    def end(self) -> None:
        """End the processes."""
        for process in self._all:
            process.end()


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
        detection: Detection = self._processes.ask(
            "detect", self._key, gripper, filters, viewpoint, arrays=[points, colors]
        )
        return detection


# -- in the other one --------------------------------------------------------------------------------------------------


class _Server:
    """Detectors, and what is asked of them."""

    def __init__(self, room: _Room) -> None:
        self._room = room
        self._detectors: dict[Key, GraspDetector] = {}

    def answer(self, task: str, key: Key, given: tuple[Any, ...]) -> Any:
        detector = self._detectors.pop(key, None) or GraspDetector(*key)
        self._detectors[key] = detector
        while len(self._detectors) > _KEPT:  # those that were asked for longest ago
            del self._detectors[next(iter(self._detectors))]
        if task == "prepare":
            return detector.model, detector.device
        places, gripper, filters, viewpoint = given
        points, colors = self._room.arrays(places)
        assert points is not None
        return detector.detect(points, gripper, colors, filters=filters, viewpoint=viewpoint)


def serve(line: Connection, room: _Room) -> None:
    """Answer until nobody asks any more."""
    server = _Server(room)
    while True:
        try:
            task, key, given = line.recv()
        except (EOFError, OSError):
            return
        try:
            answer = True, server.answer(task, key, given)
        except InvalidInputError as error:
            answer = False, error
        except Exception as error:
            print("".join(traceback.format_exception(error)), file=sys.stderr)
            answer = False, f"{type(error).__name__}: {error}"
        with contextlib.suppress(OSError):
            line.send(answer)


def main() -> int:
    """The program of a process: file descriptors of the line and the room, and the number of threads."""
    line, room, threads = (int(argument) for argument in sys.argv[1:4])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C reaches all processes; the node ends this one
    keep_freed_memory()
    use_threads(threads)
    serve(Connection(line), _Room(room))
    return 0


if __name__ == "__main__":
    sys.exit(main())
