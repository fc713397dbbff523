"""Two processes under one name: the older incarnation gives way, because a receiver of both takes the newer one.

Each process shows a token and watches the tokens of its own name. The token of a killed incarnation may be seen for a
while after its end; if the clock was set back since, that incarnation even looks newer. So a process gives way only
after the time in which the bus notices a death.
"""

from __future__ import annotations

from agents.messages.keys import incarnation_of
from agents.messages.packing import Incarnation
from agents.peers.rejections import LONGEST_LEAD_S
from agents.runtime.presence import MAX_INCARNATIONS
from dsse_core.errors import DsseError

# The larger of both: longer than the bus takes to notice a death (2 s or 8 heartbeats).
OVERLAP_S, OVERLAP_HEARTBEATS = 3.0, 12.0
GIVES_WAY = "gives way to a newer incarnation"  # leave message of the older one
REPLACED_CODE = 3  # its exit code: if it were restarted, it would be newer and replace the other process


class ReplacedError(DsseError):
    """Another process runs under the name of this one, and began later or has a newer file."""


def find_overlap_s(heartbeat_s: float) -> float:
    """Longest time for which the token of a process may be seen after its end, s."""
    return max(OVERLAP_S, OVERLAP_HEARTBEATS * heartbeat_s)


class DuplicateGuard:
    """Newer incarnations seen by process ``whom``, incarnation ``own``; ``now``: monotonic time, s."""

    def __init__(self, whom: str, own: Incarnation, now: float, heartbeat_s: float) -> None:
        self._overlap_s = find_overlap_s(heartbeat_s)
        self._whom = whom
        self._own = own
        self._began = now
        self._since: dict[Incarnation, float] = {}  # newer incarnation -> when it was first seen

    def take(self, key: str, alive: bool, now: float) -> None:
        """Note that the token on ``key`` appeared or vanished; a token from the future is ignored, as messages are."""
        incarnation = incarnation_of(key)
        latest_ms = self._own.start_ms + 1000 * (now - self._began + LONGEST_LEAD_S)
        if incarnation is None:
            return
        if not alive:
            self._since.pop(incarnation, None)
        elif self._own < incarnation and incarnation.start_ms <= latest_ms and len(self._since) < MAX_INCARNATIONS:
            self._since.setdefault(incarnation, now)

    def forget(self) -> None:
        """Know of no newer incarnation any more, until it is seen again."""
        self._since.clear()

    def next_due(self) -> float:
        """Earliest time at which ``check`` may raise, monotonic, s; infinity without a newer incarnation."""
        return min(self._since.values(), default=float("inf")) + self._overlap_s

    def check(self, now: float) -> None:
        """Raise ReplacedError if a newer incarnation has been there for so long that it must be alive."""
        for incarnation, since in self._since.items():
            if now - since >= self._overlap_s:
                raise ReplacedError(
                    f"two processes run as {self._whom} at once: this incarnation, {self._own}, and a newer one, "
                    f"{incarnation}; this one ends. Stop the other one if it is not wanted, and start this one again"
                )
