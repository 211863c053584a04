"""Worker processes as their parent sees them."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any

from benchmarks import errors
from benchmarks.errors import BenchmarkError
from benchmarks.machine import ROOT

_PATIENCE = 1800.0
"""No measurement takes so long [s]."""
_LAST_WORDS = 4000
"""So much of the end of what a worker printed is shown when it died."""


class Worker:
    """A process that measures, ready when it is made.

    Args:
        kind: of task, one of worker.py.
        threads: that its computations use.
        settings: what the task is made of, as JSON holds it.
        environment: added to that of this process.

    Raises:
        BenchmarkError: the task cannot be made.
    """

    def __init__(
        self, kind: str, threads: int, settings: Mapping[str, Any], environment: Mapping[str, str] | None = None
    ) -> None:
        self._kind = kind
        # The process's own number of threads must not come from a variable that this one was started with.
        surroundings = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the process
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.worker", kind],
            cwd=ROOT,
            env={**surroundings, **(environment or {})},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
        )
        self._unread = b""
        try:
            self.facts: dict[str, Any] = self._exchange({"threads": threads, **settings})
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    def ask(self, method: str = "measure", **arguments: Any) -> dict[str, Any]:
        """One measurement.

        Raises:
            BenchmarkError: it cannot be made, or the process died.
        """
        return self._exchange({"method": method, **arguments})

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._log.close()

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _exchange(self, request: Mapping[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError as error:
            raise self._died() from error
        answer = json.loads(self._line())
        if "error" in answer:
            kind = getattr(errors, answer["error"]["kind"], BenchmarkError)
            raise kind(answer["error"]["message"])
        return dict(answer["result"])

    def _line(self) -> bytes:
        assert self._process.stdout is not None
        deadline, stream = time.monotonic() + _PATIENCE, self._process.stdout.fileno()
        while b"\n" not in self._unread:
            ready, _, _ = select.select([stream], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                raise BenchmarkError(f"the worker for {self._kind} did not answer within {_PATIENCE:.0f} s")
            chunk = os.read(stream, 1 << 16)
            if not chunk:
                raise self._died()
            self._unread += chunk
        line, _, self._unread = self._unread.partition(b"\n")
        return line

    def _died(self) -> BenchmarkError:
        code = self._process.wait()
        self._log.seek(0)
        words = self._log.read()[-_LAST_WORDS:].decode(errors="replace").strip()
        return BenchmarkError(f"the worker for {self._kind} ended with exit code {code}:\n{words}")
