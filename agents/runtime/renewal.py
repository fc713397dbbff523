"""Renewal of keys and access rules: on SIGHUP a process reads them from their files again."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from enum import Enum

from dsse_core import operating_system


class Renewal(Enum):
    """Item in the inbox of a process that got SIGHUP."""

    ASKED = "asked"


def on_hangup(ask: Callable[[], None], end: Callable[[], None]) -> None:
    """Call ``ask`` on SIGHUP, or ``end`` if the signal came because the terminal of this process was closed.

    On a system without SIGHUP nothing happens: new keys are taken up by a restart. Under nohup a closed terminal is
    ignored; later signals call ``ask``.
    """
    if operating_system.HANGUP is None:
        return
    had_terminal = _has_terminal()
    goes_on = signal.getsignal(operating_system.HANGUP) == signal.SIG_IGN

    def handle(*_: object) -> None:
        nonlocal had_terminal
        if had_terminal and not _has_terminal():
            had_terminal = False
            if not goes_on:
                end()
        else:
            ask()

    signal.signal(operating_system.HANGUP, handle)


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | operating_system.FLAG_NO_TERMINAL))
    except OSError:
        return False
    return True
