"""The heap of a process, kept small where the C library is glibc; elsewhere nothing happens."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # of <malloc.h>
WORK_S = 0.005  # which leaves so much free memory that to give it back, some 0.1 ms, is worth it
LARGE = 2**20  # bytes; what is as large goes back to the system as soon as it is free
# The same of a process that computes once and ends: to clear pages takes a fifth of its time. glibc takes no more.
LARGE_ALONE = 2**25
KEPT_ALONE = 2**30  # bytes free at the end of the heap that such a process keeps for what comes next


def _find(name: str) -> Callable[..., int]:
    try:
        found: Callable[..., int] = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # no such function, or no such way to look for it
        return lambda *_: 0
    return found


_mallopt, _malloc_trim = _find("mallopt"), _find("malloc_trim")


def keep_small() -> None:
    """One heap for all threads of this process, and what is free at its end, or LARGE, goes back to the system."""
    _set(LARGE, LARGE)


def keep_all() -> None:
    """The heap of a process that computes once and ends: what is free serves again, but for what is LARGE_ALONE."""
    _set(KEPT_ALONE, LARGE_ALONE)


def _set(kept: int, large: int) -> None:
    for option, value in ((M_ARENA_MAX, 1), (M_TRIM_THRESHOLD, kept), (M_MMAP_THRESHOLD, large)):
        _mallopt(option, value)


class Heap:
    """Free memory of a process that works now and then: it goes back after ``WORK_S`` of work, none at rest."""

    def __init__(self) -> None:
        self._worked_s = WORK_S  # the start was work

    def tidy_after(self, worked_s: float) -> None:
        """Give free memory back if there was so much work since the last time, the latest for ``worked_s``."""
        self._worked_s += worked_s
        if self._worked_s >= WORK_S:
            self._worked_s = 0.0
            give_back()


def give_back() -> None:
    """Give free pages between what is in use back to the system; some 0.1 ms of 10 MiB."""
    _malloc_trim(0)
