"""Results that are computed when somebody asks for them, and once."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Result = TypeVar("Result")


class Later(Generic[Result]):
    """``later()`` gives the result: who asks first computes it, who asks meanwhile waits.

    A computation that fails raises for everyone who asks, and is tried again for each.
    """

    def __init__(self, compute: Callable[[], Result]) -> None:
        """Args:
        compute: without arguments; it may ask others that are ``Later``, but none that asks this one.
        """
        self._compute: Callable[[], Result] | None = compute
        self._result: Result
        self._computing = threading.Lock()

    def __call__(self) -> Result:
        """The result."""
        with self._computing:
            if self._compute is not None:
                self._result = self._compute()
                self._compute = None  # and what it holds
            return self._result
