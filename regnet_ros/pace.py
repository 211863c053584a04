"""Keeping pace: a node that prepares messages begins when whoever works on them is about to have time for one.

Otherwise a fast camera has two cores prepare clouds that a slower detector never looks at, and takes them from it.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from statistics import median

_PATIENCE = 2.0
"""A message that was sent and not followed by a request was lost; the next one is prepared after this time [s]."""
_RECENT = 5


class Usual:
    """How long something takes, as it did lately."""

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_RECENT)

    def add(self, seconds: float) -> None:
        """It took so long."""
        self._recent.append(seconds)

    @property
    def seconds(self) -> float | None:
        """The median of the last few; None before the first."""
        return median(self._recent) if self._recent else None


class Pace:
    """When to begin with the next message. Times are those of one monotonic clock [s]."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._takes = Usual()
        self._sent = -math.inf
        self._due: float | None = None
        """When the next message is wanted; None where nobody asked since the last one was sent."""

    def wanted(self, due: float) -> None:
        """Whoever works on the messages asked for one at this time; of several, the first one is served."""
        with self._lock:
            self._due = due if self._due is None else min(due, self._due)

    def sent(self, begun: float, now: float) -> None:
        """A message was sent whose preparation had begun at that time."""
        with self._lock:
            self._takes.add(now - begun)
            self._sent, self._due = now, None

    def pause(self, now: float) -> float:
        """How long to wait before the next one is begun; 0 or less: now is the time."""
        with self._lock:
            if self._due is None:
                return self._sent + _PATIENCE - now
            return self._due - (self._takes.seconds or 0.0) - now
