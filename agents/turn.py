"""Whose word an area waits for: before it tells its neighbours something, and before it judges and shows its state.

Both save what would be out of date at once. In a new scan a neighbour is told nothing while others are about to speak,
so that news climbs from the leaves of the tree of areas and comes down again. And judging and showing a state that an
answer will change takes as long as the answer itself.
"""

from __future__ import annotations

import math

ANSWER_S = 0.0025  # in which neighbours that have something to say to what they were told usually do
LONGEST_TALK_S = 0.025  # after which an area at rest shows what it has, however often it is answered


class Turn:
    """``awaited``: neighbours about to speak of a new scan. ``show_at``: when answers are no longer waited for."""

    def __init__(self) -> None:
        self.awaited: set[str] = set()
        self.show_at = math.inf
        self._talk_since = math.inf  # when neighbours were told first of what has not been shown yet

    def wait_for(self, awaited: set[str]) -> None:
        """If there are any, what was to be shown is of the last scan."""
        self.awaited = awaited
        if awaited:
            self.end_talk()

    @property
    def is_held_back(self) -> bool:
        """Whether nobody at all may be told anything."""
        return len(self.awaited) > 1

    def may_tell(self, name: str) -> bool:
        return not self.awaited - {name}

    def may_show(self, now: float) -> bool:
        return not self.awaited and not now < self.show_at < math.inf

    def await_answers(self, now: float) -> None:
        """A neighbour has been told something new."""
        self._talk_since = min(self._talk_since, now)
        self.show_at = min(now + ANSWER_S, self._talk_since + LONGEST_TALK_S)

    def end_talk(self) -> None:
        self.show_at = self._talk_since = math.inf
