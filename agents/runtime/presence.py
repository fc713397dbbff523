"""Who is there: every life of a process shows a presence token of its own, which vanishes with it.

A process that ends in order says so on the key of its token before it goes (``read_farewell``); one that dies does
not. A process that was killed and started again may be there before the bus notices the end of its former life; a
name is present as long as any of its lives is.
"""

from __future__ import annotations

import random
import re
import time

from agents.messages.checks import LONGEST_NAME
from agents.messages.keys import life_of, name_of_live
from agents.messages.packing import Incarnation

FAREWELL = re.compile(rb"[A-Za-z0-9 ._-]{1,40}")


def read_farewell(payload: bytes) -> str:
    """Why a process says that it goes, in a word or two; empty for anything else."""
    return payload.decode("ascii") if FAREWELL.fullmatch(payload) else ""


def begin_life() -> Incarnation:
    """The incarnation of a process that starts now."""
    return Incarnation(time.time_ns() // 1_000_000, random.getrandbits(32))


MAX_NAMES = 20_000  # that are kept in mind, and
MAX_LIVES = 100  # of each: whoever may show tokens may show many


class Presence:
    """Keeps the lives of every name whose tokens are there; what is not written as a life is none."""

    def __init__(self) -> None:
        self._lives: dict[tuple[str, str], set[Incarnation]] = {}  # role and name -> those whose tokens are there

    @property
    def names(self) -> set[tuple[str, str]]:
        """(role, name) of all that are there."""
        return set(self._lives)

    def lives_of(self, role: str, name: str) -> list[Incarnation]:
        """All lives of a name that are there, the newest last."""
        return sorted(self._lives.get((role, name), ()))

    def forget(self) -> list[tuple[str, str]]:
        """Know of nobody any more; (role, name) of all that were there."""
        names = sorted(self._lives)
        self._lives.clear()
        return names

    def take_farewell(self, key: str) -> bool:
        """Note that the life that shows the token on ``key`` ends; whether its name is gone, now or already.

        The farewell and the end of the token may overtake each other.
        """
        self.take(key, False)
        return name_of_live(key) not in self._lives

    def take(self, key: str, alive: bool) -> bool:
        """Note that the token on ``key`` appeared or vanished; whether its name came, came anew or went with it."""
        name, life = name_of_live(key), life_of(key)
        lives = self._lives.get(name, set())
        if life is None or (life in lives) == alive:
            return False
        if not alive:
            lives.remove(life)
            if not lives:
                del self._lives[name]
            return not lives
        is_too_much = len(self._lives) >= MAX_NAMES if name not in self._lives else len(lives) >= MAX_LIVES
        if is_too_much or max(map(len, key.split("/"))) > LONGEST_NAME:
            return False
        self._lives.setdefault(name, lives).add(life)
        return True
