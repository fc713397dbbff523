"""Waiting for processes: conditions with deadlines, which a machine keeps that is ten times slower than usual."""

from __future__ import annotations

import time
from collections.abc import Callable

import psutil

DEADLINE_S = 180.0


def wait_until(holds: Callable[[], bool], deadline_s: float = DEADLINE_S) -> None:
    deadline = time.monotonic() + deadline_s
    while not holds():
        assert time.monotonic() < deadline, f"did not happen within {deadline_s} s"
        time.sleep(0.01)


def is_gone(pid: int) -> bool:
    """Whether the process has ended; one that nobody has collected yet counts as gone."""
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
