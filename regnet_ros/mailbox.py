"""A mailbox for one item: who puts in a newer one replaces the older one, so that work is always on the newest."""

from __future__ import annotations

import math
import threading
import time
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Mailbox(Generic[Item]):
    """Holds at most one item; safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._item: Item | None = None
        self.put_at = -math.inf
        """When the item that waits, or was taken last, came in [s, monotonic]."""

    def put(self, item: Item) -> bool:
        """Put an item in; True when it replaced one that nobody had taken."""
        with self._lock:
            replaced = self._item is not None
            self._item, self.put_at = item, time.monotonic()
            return replaced

    def put_if_empty(self, item: Item) -> bool:
        """Put an item in unless one waits; True when it was put in."""
        with self._lock:
            if self._item is not None:
                return False
            self._item, self.put_at = item, time.monotonic()
            return True

    def take(self) -> Item | None:
        """Take the item out; None when there is none."""
        with self._lock:
            item, self._item = self._item, None
            return item
