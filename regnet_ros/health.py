"""What a node tells about itself in /diagnostics: rates, times of the stages, counts, what went wrong last."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from regnet_core.report import StepReport

_WINDOW = 5.0
"""Rates are averages over this many seconds."""


class RateMeter:
    """Events per second over the last ``_WINDOW`` seconds."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=10_000)

    def tick(self, now: float) -> None:
        """Count an event at time ``now`` [s]."""
        self._times.append(now)

    def rate(self, now: float) -> float:
        """The rate at time ``now`` [Hz]."""
        while self._times and now - self._times[0] > _WINDOW:
            self._times.popleft()
        return len(self._times) / _WINDOW


class Health:
    """Collects events from the node's threads and makes one DiagnosticStatus of them."""

    def __init__(self, *, awaits: str) -> None:
        """``awaits``: what the node needs to have something to do, for the message while nothing comes."""
        self._lock = threading.Lock()
        self.awaits: Callable[[], str] = lambda: awaits
        """Says what the node needs to have something to do."""
        self.facts: Mapping[str, str] = {}
        """What else to show, such as the model in use; replaced as a whole."""
        self._started = time.monotonic()
        self._last_input: float | None = None
        self._input, self._output = RateMeter(), RateMeter()
        self._received = self._dropped = self._processed = self._failed = 0
        self._stages: dict[str, float] = {}
        self._counts: dict[str, str] = {}
        self._reason = self._error = self._last_error = ""

    def received(self) -> None:
        """An input came in."""
        with self._lock:
            self._last_input = time.monotonic()
            self._received += 1
            self._input.tick(self._last_input)

    def dropped(self) -> None:
        """An input was passed over because a newer one came."""
        with self._lock:
            self._dropped += 1

    def succeeded(
        self,
        stages: Mapping[str, float],
        steps: Iterable[StepReport] = (),
        counts: Mapping[str, int] | None = None,
        reason: str = "",
    ) -> bool:
        """An input was worked on; whether the verdict on the node changed by that.

        Args:
            stages: seconds of each stage.
            steps: what each step inside regnet_core kept and rejected, and its time.
            counts: other numbers to show.
            reason: why there is no result, or what to beware of; empty when all is well.
        """
        with self._lock:
            self._processed += 1
            self._output.tick(time.monotonic())
            self._stages = dict(stages)
            self._counts = {name: str(count) for name, count in (counts or {}).items()}
            for step in steps:
                self._counts[step.name] = f"kept {step.kept}, rejected {step.rejected}, {1e3 * step.seconds:.1f} ms"
            before = self._reason, self._error
            self._reason, self._error = reason, ""
            return before != (self._reason, self._error)

    def failed(self, message: str) -> None:
        """An input, a request or a transition could not be worked on."""
        with self._lock:
            self._failed += 1
            self._error = self._last_error = message

    def recovered(self) -> None:
        """What failed before is settled (a transition that succeeds)."""
        with self._lock:
            self._error = self._reason = ""

    def status(self, name: str, state: str, stale_after: float) -> DiagnosticStatus:
        """The status now.

        Args:
            name: full name of the node.
            state: label of its lifecycle state.
            stale_after: after how many seconds without input an active node is stale.
        """
        with self._lock:
            now = time.monotonic()
            level, message = self._verdict(state, now, stale_after)
            values = {
                "state": state,
                **self.facts,
                "input rate [Hz]": f"{self._input.rate(now):.2f}",
                "output rate [Hz]": f"{self._output.rate(now):.2f}",
                "received": str(self._received),
                "processed": str(self._processed),
                "dropped for a newer one": str(self._dropped),
                "failed": str(self._failed),
                **{f"latency {stage} [ms]": f"{1e3 * seconds:.1f}" for stage, seconds in self._stages.items()},
                **self._counts,
                "reason": self._reason,
                "last error": self._last_error,
            }
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        return DiagnosticStatus(level=level, name=name, message=message, hardware_id="", values=pairs)

    def _verdict(self, state: str, now: float, stale_after: float) -> tuple[bytes, str]:
        if self._error:
            return DiagnosticStatus.ERROR, self._error
        if state != "active":
            return DiagnosticStatus.OK, f"{state}: the node works once it is activated"
        if self._last_input is None:
            level = DiagnosticStatus.STALE if now - self._started > stale_after else DiagnosticStatus.OK
            return level, f"waiting for {self.awaits()}"
        if now - self._last_input > stale_after:
            return DiagnosticStatus.STALE, f"no input for {now - self._last_input:.1f} s; waiting for {self.awaits()}"
        if self._reason:
            return DiagnosticStatus.WARN, self._reason
        return DiagnosticStatus.OK, "working"
