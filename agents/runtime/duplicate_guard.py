"""Two processes under one name: the older life gives way, as whoever hears both takes the newer one's word.

Each shows a token and watches those of its own name. A life that has been killed may be seen for a while after its
end; if the clock was set back since, it even looks newer. So nobody gives way before the bus must have noticed a death.
"""

from __future__ import annotations

from agents.messages.keys import life_of
from agents.messages.packing import Incarnation
from agents.protocol.rejections import LONGEST_LEAD_S
from agents.runtime.presence import MAX_LIVES
from dsse_core.errors import DsseError

OVERLAP_S, OVERLAP_BEATS = 3.0, 4.5  # the larger: longer than the bus takes to notice a death (2 s or 3 beats)
GIVES_WAY = "gives way to a newer life"  # farewell of the older one
REPLACED_CODE = 3  # its exit code: started again, it would be the newer one, and the other one would have to go


class ReplacedError(DsseError):
    """Another process runs under our name, and began later."""


class Succession:
    """What process ``whom``, life ``own``, has seen of newer lives of its name; ``now``: monotonic time, s."""

    def __init__(self, whom: str, own: Incarnation, now: float, beat_s: float) -> None:
        self._overlap_s = max(OVERLAP_S, OVERLAP_BEATS * beat_s)
        self._whom = whom
        self._own = own
        self._began = now
        self._since: dict[Incarnation, float] = {}  # newer life -> when it was first seen

    def take(self, key: str, alive: bool, now: float) -> None:
        """Note that the token on ``key`` appeared or vanished; one from the future is nobody's, as its messages are."""
        life = life_of(key)
        latest_ms = self._own.start_ms + 1000 * (now - self._began + LONGEST_LEAD_S)
        if life is None:
            return
        if not alive:
            self._since.pop(life, None)
        elif self._own < life and life.start_ms <= latest_ms and len(self._since) < MAX_LIVES:
            self._since.setdefault(life, now)

    def forget(self) -> None:
        """Know of no newer life any more, until it is seen again."""
        self._since.clear()

    def next_due(self) -> float:
        """When ``check`` may have something to say; infinity if nobody newer is there."""
        return min(self._since.values(), default=float("inf")) + self._overlap_s

    def check(self, now: float) -> None:
        """Raise ReplacedError if a newer life has been there for so long that it must be alive."""
        for life, since in self._since.items():
            if now - since >= self._overlap_s:
                raise ReplacedError(
                    f"two processes run as {self._whom} at once: this one, life {self._own}, and a newer one, life "
                    f"{life}; this one ends. Stop the other one if it is not wanted, and start this one again"
                )
