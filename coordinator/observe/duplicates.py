"""Areas and plants that run twice, as who watches presence tokens finds them: two lives of one name at once."""

from __future__ import annotations

from dataclasses import dataclass

from agents.messages.keys import life_of, name_of_live
from agents.messages.packing import Incarnation
from agents.runtime.duplicate_guard import GIVES_WAY
from agents.runtime.presence import MAX_LIVES

SURE_S, SURE_BEATS = 2.5, 3.75  # the larger: when the bus must have noticed a death, and nobody has given way yet
NOUNS = {"area": "agents of area {}", "plant": "plants"}


@dataclass(frozen=True, slots=True)
class Double:
    """Two processes of one name that were on the bus at once, by their lives."""

    role: str
    name: str
    older: str
    newer: str

    def __str__(self) -> str:
        return describe_double(self.role, self.name, (self.older, self.newer))


def describe_double(role: str, name: str, lives: tuple[str, ...]) -> str:
    """In a sentence; ``lives``: from the oldest to the newest."""
    who = NOUNS[role].format(name)
    return f"{len(lives)} {who} publish at once, lives {' and '.join(lives)}: the newest one's word counts"


class Doubles:
    """Finds each double once, when it is sure: the older one says that it gives way, or both are there for long.

    A process that was killed and started again is none: its former token may be there for a while, and no longer.
    ``found``: all up to now.
    """

    def __init__(self, beat_s: float) -> None:
        self._sure_s = max(SURE_S, SURE_BEATS * beat_s)
        self.found: list[Double] = []
        self._since: dict[tuple[str, str], dict[Incarnation, float]] = {}  # role and name -> life -> first seen, s

    def take(self, key: str, alive: bool, now: float, farewell: str = "") -> Double | None:
        """Note that the token on ``key`` appeared or vanished; ``farewell``: what its process has said before."""
        whose, life = name_of_live(key), life_of(key)
        if life is None or whose[0] not in NOUNS:
            return None
        lives = self._since.setdefault(whose, {})
        if alive and len(lives) < MAX_LIVES:
            lives.setdefault(life, now)
        elif not alive:
            lives.pop(life, None)  # gone already, if the end of the token has overtaken the farewell
            newest = max(lives, default=life)
            return self._note(whose, life, newest) if newest > life and farewell == GIVES_WAY else None
        return None

    def find_lasting(self, now: float) -> list[Double]:
        """Those that have been there together for long, and were not told yet."""
        told = []
        for whose, lives in self._since.items():
            if len(lives) > 1:
                older, newer = sorted(lives)[-2:]
                if now - max(lives[older], lives[newer]) >= self._sure_s:
                    told.append(self._note(whose, older, newer))
        return [double for double in told if double]

    def _note(self, whose: tuple[str, str], older: Incarnation, newer: Incarnation) -> Double | None:
        double = Double(*whose, str(older), str(newer))
        if len(self.found) >= MAX_LIVES or any((d.name, d.older) == (double.name, double.older) for d in self.found):
            return None
        self.found.append(double)
        return double
