"""Whose word an area waits for: before it tells its neighbours something, and before it judges and shows its state.

All of it saves what would be out of date at once. In a new scan a neighbour is told nothing while others are about to
speak, so that news climbs from the leaves of the tree of areas and comes down again. A neighbour that has something to
say to what it was told says it before it is told more: else each area would pass on every word of every other, and
the more areas there are, the more ways lead from one to the other. And judging and showing a state that an answer will
change takes as long as the answer itself. What is shown before whoever had to wait is told all, is not final.
"""

from __future__ import annotations

import math

ANSWER_S = 0.005  # in which neighbours that have something to say to what they were told usually do
LONGEST_TALK_S = 0.025  # after which an area at rest shows what it has, however often it is answered


class Turn:
    """``awaited``: neighbours about to speak of a new scan. ``held``: neighbours that are to be told more later."""

    def __init__(self) -> None:
        self.awaited: set[str] = set()
        self.held: set[str] = set()
        self._asked: dict[str, float] = {}  # neighbours that have not answered yet -> until when that is waited for
        self._talk_until = math.inf  # when what neighbours have been told is shown, however often they answer

    @property
    def show_at(self) -> float:
        """When answers are no longer waited for before the state is shown; infinity if nobody has been asked."""
        if self._talk_until == math.inf:
            return math.inf
        return min(max(self._asked.values(), default=-math.inf), self._talk_until)

    def next_due(self) -> float:
        """When there will be something to do, if nothing is heard until then."""
        held_until = min(map(self._free_at, self.held), default=math.inf)
        return held_until if self.awaited else min(held_until, self.show_at)

    @property
    def is_held_back(self) -> bool:
        """Whether nobody at all may be told anything."""
        return len(self.awaited) > 1

    def has_more(self, now: float) -> bool:
        """Whether somebody who had to wait may be told more now."""
        return any(self._free_at(name) <= now for name in self.held)

    def may_tell(self, name: str, now: float) -> bool:
        """Whether ``name`` may be told something; if not, it will be its turn later."""
        may = self._free_at(name) <= now
        (self.held.discard if may else self.held.add)(name)
        return may

    def _free_at(self, name: str) -> float:
        """When ``name`` may be told something, if nothing is heard until then."""
        return math.inf if self.awaited - {name} else self._asked.get(name, -math.inf)

    def may_show(self, now: float) -> bool:
        """Whether everybody has been told everything and has had time to answer, or the talk has lasted too long."""
        if self.awaited or now < self.show_at < math.inf:
            return False
        return not self.held or now >= self._talk_until

    def await_answer(self, name: str, now: float) -> None:
        """Neighbour ``name`` has been told what it may have an answer to."""
        self._asked[name] = now + ANSWER_S
        if not self.awaited:  # until they have spoken nothing is shown anyway
            self._talk_until = min(self._talk_until, now + LONGEST_TALK_S)

    def take_answer(self, name: str) -> None:
        """Neighbour ``name`` has said something new."""
        self._asked.pop(name, None)

    def show(self) -> None:
        """The state is shown: the next word begins another talk."""
        self._talk_until = math.inf

    def forget(self) -> None:
        """What neighbours have been told is out of date: no answer to it is waited for."""
        self._talk_until = math.inf
        self._asked.clear()
        self.held.clear()
