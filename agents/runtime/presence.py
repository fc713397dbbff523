"""Presence of processes: every incarnation shows a presence token of its own, which vanishes with it.

A process that ends in order publishes a leave message on the key of its token first (``read_leave``); one that dies
does not. A process that was killed and started again may be there before the bus notices the end of its former
incarnation. A name is present as long as any of its incarnations is.
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
    """Reason that a process gives for its end, in a few words; empty for a payload that is no leave message."""
    return payload.decode("ascii") if LEAVE.fullmatch(payload) else ""


def begin_incarnation(former: Incarnation | None = None) -> Incarnation:
    """The incarnation of a process that starts now; of one that goes on, newer than its ``former`` one."""
    start_ms = time.time_ns() // 1_000_000
    return Incarnation(max(start_ms, former.start_ms + 1) if former else start_ms, random.getrandbits(32))


MAX_NAMES = 20_000  # that are kept, and
MAX_INCARNATIONS = 100  # of each name: a process that may show tokens may show many


class Presence:
    """Incarnations of every name whose tokens are there; keys that are not written as incarnations are ignored."""

    def __init__(self) -> None:
        self._incarnations: dict[
            tuple[str, str], set[Incarnation]
        ] = {}  # role and name -> those whose tokens are there

    def copy(self) -> Presence:
        """An independent copy with the same incarnations."""
        made = Presence()
        made._incarnations = {name: set(incarnations) for name, incarnations in self._incarnations.items()}
        return made

    @property
    def names(self) -> set[tuple[str, str]]:
        """(role, name) of all that are there."""
        return set(self._incarnations)

    def has(self, role: str, name: str) -> bool:
        """True where a token of this name is there."""
        return (role, name) in self._incarnations

    def incarnations_of(self, role: str, name: str) -> list[Incarnation]:
        """All incarnations of a name that are there, the newest last."""
        return sorted(self._incarnations.get((role, name), ()))

    def forget(self) -> list[tuple[str, str]]:
        """Forget all tokens; returns (role, name) of all that were there, sorted."""
        names = sorted(self._incarnations)
        self._incarnations.clear()
        return names

    def take_leave(self, key: str) -> bool:
        """Note that the incarnation that shows the token on ``key`` ends; True where its name is gone, now or already.

        The leave message and the end of the token may overtake each other.
        """
        self.take(key, False)
        return name_of_live(key) not in self._incarnations

    def take(self, key: str, alive: bool) -> bool:
        """Note that the token on ``key`` appeared or vanished.

        True where a new incarnation of its name appeared, or the last one of it vanished.
        """
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
