"""Choice of a process between compiling and doing without, and listeners that report when it compiles.

Compiling takes so long that users must be told why they wait.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dsse_core.code_places import Whole, find_folder_to_keep_in, has_whole

# Compiling the estimate takes 20 to 25 s of a processor. Without it a command takes some 80 us more for each bus. From
# the first number of buses on a command compiles after its answer; from the second on before it, which is sooner.
FEWEST_BUSES_AFTERWARDS, FEWEST_BUSES_AT_ONCE = 20_000, 400_000
Listener = Callable[[bool, str | None], None]
_listeners: list[Listener] = []
_only_loads = False
_done_without: set[Whole] = set()


@contextmanager
def only_loading() -> Iterator[None]:
    """A block in which this process loads the compiled code that is kept, and compiles none where it has a choice.

    A command answers one question, which takes less time than compiling; commands use this block as a decorator. With
    FEWEST_BUSES_AT_ONCE buses the answer takes more time than compiling, so the process compiles at once.
    """
    global _only_loads
    before, _only_loads = _only_loads, True
    try:
        yield
    finally:
        _only_loads = before


def find_obstacle(what: Whole = "estimate", n_bus: int = 0) -> str | None:
    """The reason not to use the compiled code of ``what`` for a network of ``n_bus`` buses, as text; None: use it.

    Code that a large network lacks and that can be kept is remembered for ``take_done_without``.

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
    """True where ``take_done_without`` would return some code."""
    return bool(_done_without)


def take_done_without() -> set[Whole]:
    """Returns and forgets the code that this process lacked for a large network and that can be kept for later ones."""
    found = set(_done_without)
    _done_without.clear()
    return found


def listen(listener: Listener) -> None:
    """Registers ``listener``, to be called when compiling begins and when it ends.

    Its arguments: True where compiling begins; the folder that will keep the code, None for no folder and at the end.
    """
    _listeners.append(listener)


def forget_listeners() -> None:
    """Removes all listeners: a process just forked has those of its parent."""
    _listeners.clear()


def note(begins: bool, folder: str | None) -> None:
    """Tells all listeners that compiling ``begins``, or has ended, and the ``folder`` of its code."""
    for listener in _listeners:
        listener(begins, folder)
