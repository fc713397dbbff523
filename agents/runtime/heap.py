"""The heap of a process, kept small where the C library is glibc; elsewhere nothing happens."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # of <malloc.h>
WORK_S = 0.005  # leaves so much free memory that returning it to the system, some 0.1 ms, is worth it
LARGE = 2**20  # bytes; a block of this size goes back to the system as soon as it is free
# The same for a process that computes once and ends: clearing pages takes a fifth of its time. glibc's maximum.
LARGE_ALONE = 2**25
KEPT_ALONE = 2**30  # bytes free at the end of the heap that such a process keeps for later


def _find(name: str) -> Callable[..., int]:
    try:
        found: Callable[..., int] = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # no such function, or no such way to look for it
        return lambda *_: 0
    return found


_mallopt, _malloc_trim = _find("mallopt"), _find("malloc_trim")


def keep_small() -> None:
    """Keep one heap for all threads; free memory at its end, and free LARGE blocks, go back to the system."""
    _set(LARGE, LARGE)


def keep_all() -> None:
    """Keep free memory for reuse, but for LARGE_ALONE blocks: for a process that computes once and ends."""
    _set(KEPT_ALONE, LARGE_ALONE)


def _set(kept: int, large: int) -> None:
    for option, value in ((M_ARENA_MAX, 1), (M_TRIM_THRESHOLD, kept), (M_MMAP_THRESHOLD, large)):
        _mallopt(option, value)


class Heap:
    """Free memory of a process that works now and then: it goes back after ``WORK_S`` of work, and not at rest."""

    def __init__(self) -> None:
        self._worked_s = WORK_S  # the start was work

    def tidy_after(self, worked_s: float) -> None:
        """Give free memory back after ``WORK_S`` of work since the last time; ``worked_s``: the newest work, s."""
        self._worked_s += worked_s
        if self._worked_s >= WORK_S:
            self._worked_s = 0.0
            give_back()


def give_back() -> None:
    """Give free pages between used ones back to the system; this takes some 0.1 ms for 10 MiB."""
    _malloc_trim(0)
