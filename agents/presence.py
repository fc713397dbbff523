"""Who is there: every life of a process shows a presence token of its own, which vanishes with it.

A process that ends in order says so on the key of its token before it goes (``read_farewell``); one that dies does
not. A process that was killed and started again may be there before the bus notices the end of its former life; a
name is present as long as any of its lives is.
"""

from __future__ import annotations

import random
import re
import time

from agents.keys import life_of, name_of_live
from agents.messages import Incarnation

FAREWELL = re.compile(rb"[A-Za-z0-9 ._-]{1,40}")


def read_farewell(payload: bytes) -> str:
    """Why a process says that it goes, in a word or two; empty for anything else."""
    return payload.decode("ascii") if FAREWELL.fullmatch(payload) else ""


def begin_life() -> Incarnation:
    """The incarnation of a process that starts now."""
    return Incarnation(time.time_ns() // 1_000_000, random.getrandbits(32))


class Presence:
    """Keeps the lives of every name whose tokens are there."""

    def __init__(self) -> None:
        self._lives: dict[tuple[str, str], set[str]] = {}  # role and name -> keys of its tokens

    @property
    def names(self) -> set[tuple[str, str]]:
        """(role, name) of all that are there."""
        return {name for name, lives in self._lives.items() if lives}

    def lives_of(self, role: str, name: str) -> list[Incarnation]:
        """All lives of a name that are there, the newest last."""
        return sorted(filter(None, map(life_of, self._lives.get((role, name), ()))))

    def take_farewell(self, key: str) -> bool:
        """Note that the life that shows the token on ``key`` ends; whether its name is gone, now or already.

        The farewell and the end of the token may overtake each other.
        """
        self.take(key, False)
        return name_of_live(key) not in self.names

    def take(self, key: str, alive: bool) -> bool:
        """Note that the token on ``key`` appeared or vanished; whether its name came, came anew or went with it."""
        lives = self._lives.setdefault(name_of_live(key), set())
        if alive:
            new = key not in lives
            lives.add(key)
            return new
        known = key in lives
        lives.discard(key)
        return known and not lives
