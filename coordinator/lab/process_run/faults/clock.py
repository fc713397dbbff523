"""The clock of a run: publishes the duration of the run so far, by which agents time the windows of injected faults."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from agents.messages.packing import ClockMessage, Header, Incarnation, encode
from agents.security.access import COORDINATOR


@dataclass
class RunClock:
    """Publishes at every heartbeat through ``publish``; silent where it is None. ``incarnation``: the coordinator's."""

    run: str
    heartbeat_s: float
    incarnation: Incarnation
    publish: Callable[[bytes], None] | None = None
    _sent: int = 0
    _next: float = field(default=0.0)

    def tick(self, elapsed_s: float) -> None:
        """Publishes ``elapsed_s``, the duration of the run in seconds, if a heartbeat is due."""
        if self.publish is None or elapsed_s < self._next:
            return
        self._next = elapsed_s + self.heartbeat_s
        self._sent += 1
        header = Header(self.run, COORDINATOR, self.incarnation, 0, self._sent, time.time())
        self.publish(encode(ClockMessage(header, elapsed_s)))
