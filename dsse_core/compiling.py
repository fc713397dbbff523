"""Whether this process compiles, and who learns when it does: it takes long, and users wonder why."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dsse_core.code_places import Whole, has_whole

Listener = Callable[[bool, str | None], None]
_listeners: list[Listener] = []
_only_loads = False


@contextmanager
def only_loading() -> Iterator[None]:
    """Meanwhile this process loads what is kept and compiles nothing that it has a choice about: it answers one
    question, which takes less than compiling. Commands have it as a decorator.
    """
    global _only_loads
    before, _only_loads = _only_loads, True
    try:
        yield
    finally:
        _only_loads = before


def find_obstacle(what: Whole = "estimate") -> str | None:
    """Why this process does not use the compiled code of ``what``, as text.

    Raises:
        InvalidInputError: NUMBA_CACHE_DIR is set to a place that others can write.
    """
    if importlib.util.find_spec("numba") is None:
        return "numba is not installed"
    if _only_loads and not has_whole(what):
        return "the compiled solver is not there yet; `dsse compile` makes it, once, in about a minute"
    return None


def listen(listener: Listener) -> None:
    """Have ``listener`` called with whether compiling begins, and where its result will be kept; None: nowhere."""
    _listeners.append(listener)


def forget_listeners() -> None:
    """Tell nobody any more: in a process just forked, those of its parent."""
    _listeners.clear()


def note(begins: bool, folder: str | None) -> None:
    """Tell all listeners."""
    for listener in _listeners:
        listener(begins, folder)
