"""Who learns when this process begins and ends to compile: it takes long, and users wonder why."""

from __future__ import annotations

from collections.abc import Callable

Listener = Callable[[bool, str | None], None]
_listeners: list[Listener] = []


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
