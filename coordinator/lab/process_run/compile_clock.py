"""Times at which this command, or the parent of its processes, compiles. Reported once; time limits stand still."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from dsse_core import compiling


class CompileClock:
    """Notes, on any thread, the begin and the end of compiling in this process and in the parent of all processes.

    ``notify``: called with one line for the user when compiling begins for the first time.
    """

    def __init__(self) -> None:
        self.notify: Callable[[str], None] | None = None
        self._lock = threading.Lock()
        self._under_way = 0
        self._ended_at = -math.inf

    def take(self, begins: bool, folder: str | None) -> None:
        """Notes that compiling has begun, or ended. ``folder``: where the code is kept; None: nowhere."""
        with self._lock:
            self._under_way += 1 if begins else -1
            self._ended_at = time.monotonic()
            notify = self.notify if begins else None
            self.notify = None if begins else self.notify
        if notify:
            notify(describe_compiling(folder))

    def find_start(self, started: float) -> float:
        """Start of the time limit of an action begun at ``started``, monotonic, s: not before the end of all compiling,
        and now while compiling is under way.
        """
        with self._lock:
            return time.monotonic() if self._under_way else max(started, self._ended_at)


def describe_compiling(folder: str | None) -> str:
    """Line for the user about the reason for the wait, and on whether it recurs."""
    once = (
        f"this happens once: the code is kept in {folder}"
        if folder
        else "there is no safe folder to keep the code in, so that it happens each time; "
        "set NUMBA_CACHE_DIR to one, or run `dsse compile` as administrator"
    )
    return f"compiling the solvers of large radial networks, up to a minute of a processor; {once}"


clock = CompileClock()  # of this process
compiling.listen(clock.take)
