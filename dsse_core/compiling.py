"""Whether this process compiles, and who learns when it does: it takes long, and users wonder why."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dsse_core.code_places import Whole, find_folder_to_keep_in, has_whole

# Compiling the estimate takes 25 to 35 s of a processor. Without it a command takes some 80 us more for each bus: from
# so many buses on it compiles after its answer, or at once, where that is sooner.
FEWEST_BUSES_AFTERWARDS, FEWEST_BUSES_AT_ONCE = 20_000, 400_000
Listener = Callable[[bool, str | None], None]
_listeners: list[Listener] = []
_only_loads = False
_done_without: set[Whole] = set()


@contextmanager
def only_loading() -> Iterator[None]:
    """Meanwhile this process loads what is kept and compiles nothing that it has a choice about: it answers one
    question, which takes less than compiling. Commands have it as a decorator. Of FEWEST_BUSES_AT_ONCE it takes more.
    """
    global _only_loads
    before, _only_loads = _only_loads, True
    try:
        yield
    finally:
        _only_loads = before


def find_obstacle(what: Whole = "estimate", n_bus: int = 0) -> str | None:
    """The reason not to use the compiled code of ``what`` for a network of ``n_bus`` buses, as text.

    Raises:
        InvalidInputError: NUMBA_CACHE_DIR is set to a place that others can write.
    """
    if importlib.util.find_spec("numba") is None:
        return "numba is not installed"
    if not _only_loads or has_whole(what):
        return None
    is_made_later = n_bus >= FEWEST_BUSES_AFTERWARDS and find_folder_to_keep_in() is not None
    if is_made_later:
        _done_without.add(what)
    if n_bus >= FEWEST_BUSES_AT_ONCE:
        return None
    when = "it is made after this answer, once" if is_made_later else "`dsse compile` makes it, once, in about a minute"
    return f"the compiled solver is not there yet; {when}"


def has_done_without() -> bool:
    """Whether ``take_done_without`` would find something."""
    return bool(_done_without)


def take_done_without() -> set[Whole]:
    """Code that this process would have used for a large network and that can be kept for the next one; asked once."""
    found = set(_done_without)
    _done_without.clear()
    return found


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
