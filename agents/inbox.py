"""The inbox between the bus' threads and the one loop of a process: unread news of a slot is replaced by newer."""

import queue
import time
from typing import Any

MAX_WAITING = 10_000


class Inbox:
    """Many threads put, one takes. ``overflowed`` counts what was dropped because nobody took for too long."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[Any, Any]] = queue.SimpleQueue()  # put() is safe in a signal handler
        self.overflowed = 0

    def put(self, slot: Any, item: Any) -> None:
        """Leave ``item``; an earlier item of the same ``slot`` that has not been taken is superseded."""
        if self._queue.qsize() >= MAX_WAITING:
            self.overflowed += 1
        else:
            self._queue.put((slot, item))

    def take(self, timeout_s: float) -> list[Any]:
        """Wait for news up to ``timeout_s``; everything unread, the newest of each slot, in order of arrival."""
        news: dict[Any, Any] = {}
        try:
            slot, item = self._queue.get(timeout=max(0.0, timeout_s))
            while True:
                news.pop(slot, None)
                news[slot] = item
                slot, item = self._queue.get_nowait()
        except queue.Empty:
            return list(news.values())

    def take_until(self, deadline: float) -> list[Any]:
        """``take`` with a deadline on ``time.monotonic()``."""
        return self.take(deadline - time.monotonic())
