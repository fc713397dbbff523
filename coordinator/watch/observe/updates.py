"""Bounded queue between the threads of bus and processes and the single loop of a command."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any, NamedTuple

from agents.runtime.inbox import WakeUp

MAX_WAITING = 100_000  # updates, and
MOST_BYTES = 64 * 2**20  # of messages in them


class _Sized(NamedTuple):
    """A message of ``size`` bytes that waits."""

    size: int
    item: Any


class Updates:
    """Updates from bus and processes in the order of arrival; ``most`` wait, with ``most_bytes`` of messages."""

    def __init__(self, most: int = MAX_WAITING, most_bytes: int = MOST_BYTES) -> None:
        self._waiting: deque[Any] = deque()
        self._wake_up = WakeUp()
        self._most, self._most_bytes = most, most_bytes
        self._lock = threading.Lock()
        self._bytes = 0  # of messages that wait
        self._dropped = 0

    def put(self, item: Any) -> None:
        """Adds ``item``, however much waits."""
        self._waiting.append(item)
        self._wake_up.announce()

    def offer(self, item: Any, *, sent_once: bool = False, size: int = 0) -> None:
        """Adds ``item``, or drops and counts it where too much waits; items that heartbeats repeat are dropped first.

        ``sent_once``: the item is not repeated, and has twice the room. ``size``: bytes of its message and key.
        """
        with self._lock:
            share = 2 if sent_once else 1
            if len(self._waiting) < self._most * share and self._bytes + size <= self._most_bytes * share:
                self._bytes += size
                self.put(_Sized(size, item) if size else item)  # within the lock: in the order of arrival
            else:
                self._dropped += 1

    def take(self, timeout_s: float) -> list[Any]:
        """Waits up to ``timeout_s`` for an item, and returns all items that have arrived by then.

        Items that arrive during the call are left for the next one, so that the call ends under a flood of messages.
        """
        self._wake_up.wait(timeout_s)
        items = [self._waiting.popleft() for _ in range(len(self._waiting))]
        sized = [item for item in items if isinstance(item, _Sized)]
        if not sized:
            return items
        with self._lock:
            self._bytes -= sum(item.size for item in sized)
        return [item.item if isinstance(item, _Sized) else item for item in items]

    def take_dropped(self) -> int:
        """Number of items dropped since the last call."""
        with self._lock:
            dropped, self._dropped = self._dropped, 0
        return dropped
