"""The inbox between the bus' threads and the one loop of a process: the newest item of a slot is kept."""

import queue
from typing import Any

MAX_WAITING = 10_000
SUPERSEDED = object()  # a newer item of the slot is being put at this moment, and its announcement follows


class Inbox:
    """Many threads put items, one takes them. An item of a new slot is dropped while ``MAX_WAITING`` slots are unread.

    There is no lock, because signal handlers also call ``put``, and they may interrupt ``take``. Each operation on the
    dict and on the queue is atomic by itself, and ``take`` takes all items, however often they were announced.
    """

    def __init__(self) -> None:
        self._updates: dict[Any, Any] = {}
        self._announced: queue.SimpleQueue[None] = queue.SimpleQueue()

    def put(self, slot: Any, item: Any) -> None:
        """Leave ``item``; an earlier item of the same ``slot`` that has not been taken is superseded."""
        if slot not in self._updates and len(self._updates) >= MAX_WAITING:
            return
        self._updates.pop(slot, None)  # the newest goes to the end of the order
        self._updates[slot] = item
        if self._announced.qsize() < MAX_WAITING:
            self._announced.put(None)

    def take(self, timeout_s: float) -> list[Any]:
        """Wait for items up to ``timeout_s``; returns all unread ones, the newest of each slot, in order of arrival."""
        try:
            self._announced.get(timeout=max(0.0, timeout_s))
            while True:
                self._announced.get_nowait()
        except queue.Empty:
            taken = [self._updates.pop(slot, SUPERSEDED) for slot in list(self._updates)]
            return [item for item in taken if item is not SUPERSEDED]
