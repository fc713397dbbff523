"""Areas, plants and gateways that run twice, found by presence tokens: two incarnations of one name at once."""

from __future__ import annotations

from dataclasses import dataclass

from agents.messages.keys import incarnation_of, name_of_live
from agents.messages.packing import Incarnation
from agents.runtime.duplicate_guard import GIVES_WAY
from agents.runtime.presence import MAX_INCARNATIONS

SURE_S, SURE_HEARTBEATS = 2.5, 10.0  # the larger: the bus notices a death in this time, and the older one gives way
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
    """The duplicate in a sentence; ``incarnations``: from the oldest to the newest."""
    who = NOUNS[role].format(name)
    return f"{len(incarnations)} {who} publish at once: {' and '.join(incarnations)}; the newest one counts"


class Duplicates:
    """Finds each duplicate once, when it is sure: the older process says that it gives way, or both tokens last.

    A process that was killed and started again is no duplicate: its former token vanishes after a while.
    ``found``: all duplicates up to now.
    """

    def __init__(self, heartbeat_s: float) -> None:
        self._sure_s = max(SURE_S, SURE_HEARTBEATS * heartbeat_s)
        self.found: list[Duplicate] = []
        self._since: dict[
            tuple[str, str], dict[Incarnation, float]
        ] = {}  # role and name -> incarnation -> first seen, s

    def take(self, key: str, alive: bool, now: float, leave_reason: str = "") -> Duplicate | None:
        """Note that the token on ``key`` appeared or vanished; the duplicate that this proves, if any.

        ``leave_reason``: of the process's leave message, empty without one."""
        whose, incarnation = name_of_live(key), incarnation_of(key)
        if incarnation is None or whose[0] not in NOUNS:
            return None
        incarnations = self._since.setdefault(whose, {})
        if alive and len(incarnations) < MAX_INCARNATIONS:
            incarnations.setdefault(incarnation, now)
        elif not alive:
            incarnations.pop(incarnation, None)  # absent already if the token's end has overtaken the leave message
            newest = max(incarnations, default=incarnation)
            return (
                self._note(whose, incarnation, newest) if newest > incarnation and leave_reason == GIVES_WAY else None
            )
        return None

    def find_lasting(self, now: float) -> list[Duplicate]:
        """The duplicates whose tokens have been present together for long, and that are not in ``found`` yet."""
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
