"""Areas and plants that run twice, as who watches presence tokens finds them: two incarnations of one name at once."""

from __future__ import annotations

from dataclasses import dataclass

from agents.messages.keys import incarnation_of, name_of_live
from agents.messages.packing import Incarnation
from agents.runtime.duplicate_guard import GIVES_WAY
from agents.runtime.presence import MAX_INCARNATIONS

SURE_S, SURE_HEARTBEATS = 2.5, 10.0  # the larger: when the bus must have noticed a death, and nobody has given way yet
NOUNS = {"area": "agents of area {}", "plant": "plants", "gateway": "gateways {}"}


@dataclass(frozen=True, slots=True)
class Duplicate:
    """Two processes of one name that were on the bus at once, by their incarnations."""

    role: str
    name: str
    older: str
    newer: str

    def __str__(self) -> str:
        return describe_duplicate(self.role, self.name, (self.older, self.newer))


def describe_duplicate(role: str, name: str, incarnations: tuple[str, ...]) -> str:
    """In a sentence; ``incarnations``: from the oldest to the newest."""
    who = NOUNS[role].format(name)
    return f"{len(incarnations)} {who} publish at once: {' and '.join(incarnations)}; the newest one counts"


class Duplicates:
    """Finds each duplicate once, when it is sure: the older one says that it gives way, or both are there for long.

    A process that was killed and started again is none: its former token may be there for a while, and no longer.
    ``found``: all up to now.
    """

    def __init__(self, heartbeat_s: float) -> None:
        self._sure_s = max(SURE_S, SURE_HEARTBEATS * heartbeat_s)
        self.found: list[Duplicate] = []
        self._since: dict[
            tuple[str, str], dict[Incarnation, float]
        ] = {}  # role and name -> incarnation -> first seen, s

    def take(self, key: str, alive: bool, now: float, leave_reason: str = "") -> Duplicate | None:
        """Note that the token on ``key`` appeared or vanished; ``leave_reason``: the leave message before."""
        whose, incarnation = name_of_live(key), incarnation_of(key)
        if incarnation is None or whose[0] not in NOUNS:
            return None
        incarnations = self._since.setdefault(whose, {})
        if alive and len(incarnations) < MAX_INCARNATIONS:
            incarnations.setdefault(incarnation, now)
        elif not alive:
            incarnations.pop(incarnation, None)  # gone already, if the end of the token has overtaken the leave message
            newest = max(incarnations, default=incarnation)
            return (
                self._note(whose, incarnation, newest) if newest > incarnation and leave_reason == GIVES_WAY else None
            )
        return None

    def find_lasting(self, now: float) -> list[Duplicate]:
        """Those that have been there together for long, and were not reported yet."""
        found = []
        for whose, incarnations in self._since.items():
            if len(incarnations) > 1:
                older, newer = sorted(incarnations)[-2:]
                if now - max(incarnations[older], incarnations[newer]) >= self._sure_s:
                    found.append(self._note(whose, older, newer))
        return [duplicate for duplicate in found if duplicate]

    def _note(self, whose: tuple[str, str], older: Incarnation, newer: Incarnation) -> Duplicate | None:
        duplicate = Duplicate(*whose, str(older), str(newer))
        if len(self.found) >= MAX_INCARNATIONS or any(
            (d.name, d.older) == (duplicate.name, duplicate.older) for d in self.found
        ):
            return None
        self.found.append(duplicate)
        return duplicate
