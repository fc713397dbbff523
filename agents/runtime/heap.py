"""The heap of a process, kept small where the C library is glibc; elsewhere nothing happens."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # of <malloc.h>
LARGE = 2**20  # bytes; what is as large goes back to the system as soon as it is free
LARGE_ALONE = 2**25  # the same of a process that computes once and ends: to clear pages takes a fifth of its time


def _find(name: str) -> Callable[..., int]:
    try:
        found: Callable[..., int] = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # no such function, or no such way to look for it
        return lambda *_: 0
    return found


_mallopt, _malloc_trim = _find("mallopt"), _find("malloc_trim")


def keep_small(large: int = LARGE) -> None:
    """One heap for all threads of this process, and what is free at its end, or ``large``, goes back to the system."""
    for option, value in ((M_ARENA_MAX, 1), (M_TRIM_THRESHOLD, large), (M_MMAP_THRESHOLD, large)):
        _mallopt(option, value)


def give_back() -> None:
    """Give free pages between what is in use back to the system; some 0.1 ms of 10 MiB."""
    _malloc_trim(0)
