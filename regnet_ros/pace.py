"""Keeping pace: a node that prepares messages begins when whoever works on them is about to have time for one.

Otherwise a camera that is faster than the detector keeps a core busy with clouds that no detection ever sees.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from statistics import median

_PATIENCE = 2.0
"""A message that no request followed was lost; so long after its beginning the next one is begun [s]."""
_RECENT = 5
_HURRY, _EASE = 0.5, 0.1
"""What is late is asked for sooner by this share of its delay, what waits later by this share of the time it waits."""
_LATEST = 0.1
"""More than this says little about the usual delay [s]."""
_RESERVE = 0.01
"""So long may what is asked for wait [s]."""


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


class Lead:
    """How much sooner than needed something must be asked for, to be there in time."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def add(self, late: float, most: float) -> None:
        """It came so long after it was needed, or, below 0, before; ``most`` is the most that can be asked for [s]."""
        if late > 0.0:
            self.seconds += _HURRY * min(late, _LATEST)
        else:
            self.seconds -= _EASE * max(-late - _RESERVE, 0.0)
        self.seconds = min(max(self.seconds, 0.0), most)


class Pace:
    """When to begin with the next message. Times are those of one monotonic clock [s]."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._takes = Usual()
        self._begun = -math.inf
        self._due: float | None = None
        """When the next message is wanted; None where nobody asked since the last one was begun."""

    def wanted(self, due: float) -> None:
        """Whoever works on the messages asked for one at this time; of several, the first one is served."""
        with self._lock:
            self._due = due if self._due is None else min(due, self._due)

    def begun(self, now: float) -> None:
        """A message is begun. What is asked for from now on, even before it is sent, is the next one."""
        with self._lock:
            self._begun, self._due = now, None

    def sent(self, now: float) -> None:
        """The message that was begun last is sent."""
        with self._lock:
            self._takes.add(now - self._begun)

    def failed(self) -> None:
        """Nothing comes of the message that was begun last: another one is wanted in its place."""
        self.wanted(self._begun)

    def pause(self, now: float) -> float:
        """How long to wait before the next one is begun; 0 or less: now is the time."""
        with self._lock:
            if self._due is None:
                return self._begun + _PATIENCE - now
            return self._due - (self._takes.seconds or 0.0) - now
