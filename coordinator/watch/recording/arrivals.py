"""Queue of entries that have arrived from the bus and are not written yet. Bounded; it counts entries without room."""

from __future__ import annotations

import queue
import threading

from coordinator.watch.recording.entries import Entry

MOST_WAITING = 256 * 2**20  # bytes
SIZE_OF_ENTRY = 200  # bytes beside its payload


class Arrivals:
    """Filled by the threads of the bus, emptied by the recorder."""

    def __init__(self, most: int = MOST_WAITING) -> None:
        self._queue: queue.SimpleQueue[Entry] = queue.SimpleQueue()
        self._most = most
        self._lock = threading.Lock()
        self._waiting = 0
        self._dropped = 0

    def put(self, entry: Entry) -> None:
        """Adds ``entry``, or counts it as dropped where too much waits, for instance behind a disk that hangs."""
        size = len(entry.payload) + SIZE_OF_ENTRY
        with self._lock:
            if self._waiting + size > self._most:
                self._dropped += 1
                return
            self._waiting += size
            self._queue.put(entry)  # within the lock, so that the queue keeps the order of arrival

    def take(self, timeout_s: float) -> list[Entry]:
        """Waits up to ``timeout_s`` for an entry, and returns all entries that have arrived by then.

        Entries that arrive during the call are left for the next one, so that the call ends under a flood of messages.
        """
        try:
            first = self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return []
        entries = [first, *(self._queue.get_nowait() for _ in range(self._queue.qsize()))]
        with self._lock:
            self._waiting -= sum(len(entry.payload) + SIZE_OF_ENTRY for entry in entries)
        return entries

    def take_dropped(self) -> int:
        """Number of entries dropped since the last call."""
        with self._lock:
            dropped, self._dropped = self._dropped, 0
        return dropped
