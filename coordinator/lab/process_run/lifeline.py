"""Ends a child process when its parent ends for any reason: by a pipe whose writing end only the parent holds.

The system closes that end with the parent, even at SIGKILL, and the reader of the pipe sees it at once, on every POSIX
system. A death signal ordered from the system (PR_SET_PDEATHSIG) exists on Linux only.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time

from dsse_core import operating_system


class Lifeline:
    """Pipe made by the parent before it forks. Each child calls ``hold`` once, before its own code runs."""

    def __init__(self, end: int | None = None) -> None:
        """``end``: in a process that was not forked, the inherited end of its parent's lifeline."""
        self._read, self._write = (end, -1) if end is not None else os.pipe()

    @property
    def end(self) -> int:
        """File descriptor of the reading end, which a process that is not forked inherits."""
        return self._read

    def hold(self, wait_s: float, grace_s: float) -> None:
        """Starts the watch: SIGTERM to this process ``wait_s`` after the parent's end, SIGKILL ``grace_s`` later."""
        if self._write >= 0:
            os.close(self._write)
        threading.Thread(target=self._end_with_parent, args=(wait_s, grace_s), name="lifeline", daemon=True).start()

    def _end_with_parent(self, wait_s: float, grace_s: float) -> None:
        os.read(self._read, 1)  # no process writes: the read returns when the last writing end is closed
        with contextlib.suppress(OSError):
            operating_system.continue_own_group()  # a paused process could not see the end of the parent
        time.sleep(wait_s)
        # to the main thread, which runs the handlers; a signal to the process might wake another thread
        operating_system.signal_thread(threading.main_thread().ident or 0, signal.SIGTERM)
        time.sleep(grace_s)
        os.kill(os.getpid(), operating_system.KILL)
