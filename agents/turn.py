"""Whose word an area waits for: before it tells its neighbours something, and before it judges and shows its state.

All of it saves what would be out of date at once. In a new scan a neighbour is told nothing while others are about to
speak, so that news climbs from the leaves of the tree of areas and comes down again. A neighbour that has something to
say to what it was told says it before it is told more: else each area would pass on every word of every other, and
the more areas there are, the more ways lead from one to the other. And judging and showing a state that an answer will
change takes as long as the answer itself.
"""

from __future__ import annotations

import math

ANSWER_S = 0.005  # in which neighbours that have something to say to what they were told usually do
LONGEST_TALK_S = 0.025  # after which an area at rest shows what it has, however often it is answered


class Turn:
    """``awaited``: neighbours about to speak of a new scan. ``show_at``: when answers are no longer waited for.

    ``held_until``: when somebody can be told what an answer is awaited before. ``has_more``: it can be told now.
    """

    def __init__(self) -> None:
        self.awaited: set[str] = set()
        self.show_at = self.held_until = math.inf
        self.has_more = False
        self._talk_since = math.inf  # when neighbours were told first of what has not been shown yet
        self._asked: dict[str, float] = {}  # neighbours that have not answered yet -> until when that is waited for

    def wait_for(self, awaited: set[str], now: float) -> None:
        """If there are any, what was to be shown is of the last scan."""
        self.awaited = awaited
        if now >= self.held_until:
            self.held_until, self.has_more = math.inf, True
        if awaited:
            self.end_talk()

    def next_due(self) -> float:
        """When there will be something to do, if nothing is heard until then."""
        return min(self.show_at, self.held_until)

    @property
    def is_held_back(self) -> bool:
        """Whether nobody at all may be told anything."""
        return len(self.awaited) > 1

    def begin_telling(self) -> None:
        """Everybody who may be told, is told now."""
        self.held_until, self.has_more = math.inf, False

    def may_tell(self, name: str, now: float) -> bool:
        """Whether ``name`` may be told something; if only its answer is missing, it will be its turn later."""
        if self.awaited - {name}:
            return False
        answer_until = self._asked.get(name, -math.inf)
        if now < answer_until:
            self.held_until = min(self.held_until, answer_until)
        return now >= answer_until

    def may_show(self, now: float) -> bool:
        return not self.awaited and not now < self.show_at < math.inf

    def await_answer(self, name: str, now: float) -> None:
        """Neighbour ``name`` has been told what it may have an answer to."""
        self._asked[name] = now + ANSWER_S
        self._talk_since = min(self._talk_since, now)
        self.show_at = min(now + ANSWER_S, self._talk_since + LONGEST_TALK_S)

    def take_answer(self, name: str) -> None:
        """Neighbour ``name`` has said something new; after the last answer there is nothing to wait for."""
        if name in self._asked:
            del self._asked[name]
            if self.held_until < math.inf:
                self.held_until = -math.inf
            if not self._asked:
                self.show_at = -math.inf

    def show(self) -> None:
        """The state is shown; only who is still to be told something goes on waiting."""
        self.show_at = self._talk_since = math.inf
        if self.held_until == math.inf:
            self._asked.clear()

    def end_talk(self) -> None:
        """What has been told is out of date."""
        self.show_at = self.held_until = self._talk_since = math.inf
        self.has_more = False
        self._asked.clear()
