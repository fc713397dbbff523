"""The inbox between the bus' threads and the one loop of a process: the newest item of a slot is kept."""

import contextlib
import threading
from typing import Any

MAX_WAITING = 10_000
SUPERSEDED = object()  # a newer item of the slot is being put at this moment, and its announcement follows


class WakeUp:
    """Announcement from any thread or signal handler to the one thread that waits; announcements before the wait count
    as one.

    A bare lock, whose wait ends in time. That of ``queue.SimpleQueue`` never ends if a signal arrives as its timeout
    passes (CPython 3.11), and locks of Python code are not for signal handlers.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def announce(self) -> None:
        with contextlib.suppress(RuntimeError):  # announced already
            self._lock.release()

    def wait(self, timeout_s: float) -> bool:
        """Waits up to ``timeout_s`` for an announcement; False if none came."""
        return self._lock.acquire(timeout=max(0.0, timeout_s))


class Inbox:
    """Many threads put items, one takes them. An item of a new slot is dropped while ``MAX_WAITING`` slots are unread.

    The dict has no lock, because signal handlers also call ``put``, and they may interrupt ``take``. Each operation on
    it is atomic by itself, and ``take`` takes all items.
    """

    def __init__(self) -> None:
        self._updates: dict[Any, Any] = {}
        self._wake_up = WakeUp()

    def put(self, slot: Any, item: Any) -> None:
        """Leave ``item``; an earlier item of the same ``slot`` that has not been taken is superseded."""
        if slot not in self._updates and len(self._updates) >= MAX_WAITING:
            return
        self._updates.pop(slot, None)  # the newest goes to the end of the order
        self._updates[slot] = item
        self._wake_up.announce()

    def take(self, timeout_s: float) -> list[Any]:
        """Wait for items up to ``timeout_s``; returns all unread ones, the newest of each slot, in order of arrival."""
        self._wake_up.wait(timeout_s)
        taken = [self._updates.pop(slot, SUPERSEDED) for slot in list(self._updates)]
        return [item for item in taken if item is not SUPERSEDED]
