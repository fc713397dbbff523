"""Who is there: every incarnation of a process shows a presence token of its own, which vanishes with it.

A process that ends in order says so on the key of its token before it goes (``read_leave``); one that dies does
not. A process that was killed and started again may be there before the bus notices the end of its former incarnation;
a name is present as long as any of its incarnations is.
"""

from __future__ import annotations

import random
import re
import time

from agents.messages.checks import LONGEST_NAME
from agents.messages.keys import incarnation_of, name_of_live
from agents.messages.packing import Incarnation

LEAVE = re.compile(rb"[A-Za-z0-9 ._-]{1,40}")


def read_leave(payload: bytes) -> str:
    """Why a process says that it goes, in a few words; empty for anything else."""
    return payload.decode("ascii") if LEAVE.fullmatch(payload) else ""


def begin_incarnation(former: Incarnation | None = None) -> Incarnation:
    """The incarnation of a process that starts now; of one that goes on, newer than its ``former`` one."""
    start_ms = time.time_ns() // 1_000_000
    return Incarnation(max(start_ms, former.start_ms + 1) if former else start_ms, random.getrandbits(32))


MAX_NAMES = 20_000  # that are kept in mind, and
MAX_INCARNATIONS = 100  # of each name: a process that may show tokens may show many


class Presence:
    """Keeps the incarnations of every name whose tokens are there; what is not written as an incarnation is none."""

    def __init__(self) -> None:
        self._incarnations: dict[
            tuple[str, str], set[Incarnation]
        ] = {}  # role and name -> those whose tokens are there

    def copy(self) -> Presence:
        """One that knows the same, and goes its own way from here."""
        made = Presence()
        made._incarnations = {name: set(incarnations) for name, incarnations in self._incarnations.items()}
        return made

    @property
    def names(self) -> set[tuple[str, str]]:
        """(role, name) of all that are there."""
        return set(self._incarnations)

    def incarnations_of(self, role: str, name: str) -> list[Incarnation]:
        """All incarnations of a name that are there, the newest last."""
        return sorted(self._incarnations.get((role, name), ()))

    def forget(self) -> list[tuple[str, str]]:
        """Know of nobody any more; (role, name) of all that were there."""
        names = sorted(self._incarnations)
        self._incarnations.clear()
        return names

    def take_leave(self, key: str) -> bool:
        """Note that the incarnation that shows the token on ``key`` ends; whether its name is gone, now or already.

        The leave message and the end of the token may overtake each other.
        """
        self.take(key, False)
        return name_of_live(key) not in self._incarnations

    def take(self, key: str, alive: bool) -> bool:
        """Note that the token on ``key`` appeared or vanished; whether its name came, came anew or went with it."""
        name, incarnation = name_of_live(key), incarnation_of(key)
        incarnations = self._incarnations.get(name, set())
        if incarnation is None or (incarnation in incarnations) == alive:
            return False
        if not alive:
            incarnations.remove(incarnation)
            if not incarnations:
                del self._incarnations[name]
            return not incarnations
        is_too_much = (
            len(self._incarnations) >= MAX_NAMES
            if name not in self._incarnations
            else len(incarnations) >= MAX_INCARNATIONS
        )
        if is_too_much or max(map(len, key.split("/"))) > LONGEST_NAME:
            return False
        self._incarnations.setdefault(name, incarnations).add(incarnation)
        return True
