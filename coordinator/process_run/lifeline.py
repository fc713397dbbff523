"""A forked process ends with its parent, however that ends: by a pipe whose other end only the parent holds.

The system closes that end with the parent, even at SIGKILL, and the reader of the pipe learns of it at once, on every
POSIX system. A signal ordered from the system (PR_SET_PDEATHSIG) would do on Linux only.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time

from dsse_core import operating_system


class Lifeline:
    """Made by the parent before it forks; each child calls ``hold`` once, before anything of its own runs."""

    def __init__(self, end: int | None = None) -> None:
        """``end``: in a process that was not forked, the inherited end of its parent's lifeline."""
        self._read, self._write = (end, -1) if end is not None else os.pipe()

    @property
    def end(self) -> int:
        """File descriptor that a process inherits which is not forked."""
        return self._read

    def hold(self, wait_s: float, grace_s: float) -> None:
        """From now on: ``wait_s`` after the parent's death SIGTERM to this process, SIGKILL ``grace_s`` after that."""
        if self._write >= 0:
            os.close(self._write)
        threading.Thread(target=self._end_with_parent, args=(wait_s, grace_s), name="lifeline", daemon=True).start()

    def _end_with_parent(self, wait_s: float, grace_s: float) -> None:
        os.read(self._read, 1)  # nobody writes: it returns when the last writing end is closed
        with contextlib.suppress(OSError):
            operating_system.continue_own_group()  # one that was paused could not learns of it
        time.sleep(wait_s)
        # to the main thread, which runs the handlers: sent to the process, another thread might wake for it
        operating_system.signal_thread(threading.main_thread().ident or 0, signal.SIGTERM)
        time.sleep(grace_s)
        os.kill(os.getpid(), operating_system.KILL)
