"""Whose word an area waits for: before it tells its neighbours something, and before it judges and shows its state.

Both save what would be out of date at once. In a new scan a neighbour is told nothing while others are about to speak,
so that news climbs from the leaves of the tree of areas and comes down again. And judging and showing a state that an
answer will change takes as long as the answer itself. An area with very many neighbours would else tell all of them
what each of them says, in hundreds of moments one by one.
"""

from __future__ import annotations

import math

ANSWER_S = 0.005  # in which neighbours that have something to say to what they were told usually do
LONGEST_TALK_S = 0.025  # after which an area at rest shows what it has, however often it is answered
FEW = 8  # neighbours that may be told at any time
COLLECT_S = 0.00025  # for each one more that has been told: what they answer is taken in at once


class Turn:
    """``awaited``: neighbours about to speak of a new scan. ``show_at``: when answers are no longer waited for.

    ``speak_at``: when an area that has told many has collected what they answer.
    """

    def __init__(self) -> None:
        self.awaited: set[str] = set()
        self.show_at = self.speak_at = math.inf
        self._talk_since = math.inf  # when neighbours were told first of what has not been shown yet
        self._asked: set[str] = set()  # neighbours that have not answered yet

    def wait_for(self, awaited: set[str], now: float) -> None:
        """If there are any, what was to be shown is of the last scan."""
        self.awaited = awaited
        if now >= self.speak_at:
            self.speak_at = math.inf
        if awaited:
            self.end_talk()

    def next_due(self, now: float) -> float:
        """When there will be something to do, if nothing is heard until then."""
        return self.speak_at if self._collects(now) else min(self.speak_at, self.show_at)

    def is_held_back(self, now: float) -> bool:
        """Whether nobody at all may be told anything."""
        return len(self.awaited) > 1 or self._collects(now)

    def _collects(self, now: float) -> bool:
        return now < self.speak_at < math.inf

    def may_tell(self, name: str) -> bool:
        return not self.awaited - {name}

    def may_show(self, now: float) -> bool:
        return not self.awaited and not now < self.show_at < math.inf

    def await_answer(self, name: str, now: float) -> None:
        """Neighbour ``name`` has been told what it may have an answer to."""
        self._asked.add(name)
        self._talk_since = min(self._talk_since, now)
        self.show_at = min(now + ANSWER_S, self._talk_since + LONGEST_TALK_S)

    def collect(self, now: float, told: int) -> None:
        """So many neighbours have been told something new."""
        self.speak_at = now + COLLECT_S * (told - FEW) if told > FEW else math.inf

    def take_answer(self, name: str) -> None:
        """Neighbour ``name`` has said something new; after the last answer there is nothing to wait for."""
        if name in self._asked:
            self._asked.remove(name)
            if not self._asked:
                self.show_at = -math.inf

    def end_talk(self) -> None:
        self.show_at = self._talk_since = math.inf
        self._asked.clear()
