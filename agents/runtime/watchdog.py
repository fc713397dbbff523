"""Reports of a process to systemd (sd_notify): that it is ready, and from its loop that the loop goes on.

A stuck loop reports nothing, and systemd restarts the process after ``WatchdogSec`` of its unit.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress

PINGS = 4  # in the time after which systemd would restart the process
COMPILING_US = 900 * 10**6  # for which the loop may stand still, or the start may last, while solvers are compiled


class Watchdog:
    """Reports to the service manager that ``environment`` names; without one all calls do nothing."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        is_for_us = environment.get("WATCHDOG_PID") in (None, str(os.getpid()))
        limit = environment.get("WATCHDOG_USEC", "") if is_for_us else ""
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._limit_us = int(limit) if address and limit.isascii() and limit.isdigit() else 0
        self._is_ready = False
        self._next_ping = float("inf")

    def ready(self, now: float) -> None:
        """Report that the process does its work from now on; ``now``: s, of the monotonic clock."""
        self._is_ready = True
        self._notify("READY=1")
        if self._limit_us:
            self._next_ping = now

    def ping(self, now: float) -> float:
        """Report that the loop goes on, if a report is due; returns how long the loop may wait, s."""
        if now >= self._next_ping:
            self._notify("WATCHDOG=1")
            self._next_ping = now + self._limit_us * 1e-6 / PINGS
        return self._next_ping - now

    def take_compiling(self, begins: bool, _: str | None) -> None:
        """Ask for patience while the process compiles (listener of ``dsse_core/compiling.py``)."""
        if begins and not self._is_ready:
            self._notify(f"EXTEND_TIMEOUT_USEC={COMPILING_US}")
        elif self._is_ready and self._limit_us:
            self._notify(f"WATCHDOG_USEC={max(self._limit_us, COMPILING_US) if begins else self._limit_us}")

    def _notify(self, text: str) -> None:
        """Send ``text`` to the service manager, if there is one; errors are ignored."""
        if self._address:
            with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sent:
                sent.sendto(text.encode(), self._address)
