"""An agent's log of what its area works with: each thing when it comes and when it goes, not in every scan.

What comes and goes all the time is told ever more rarely, in the end once a day: a log of months stays short, and a
thing that had been as it was for a day is told at once.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from agents.protocol.events import Conclude

log = logging.getLogger(__name__)
FIRST_WAIT_S = 10.0  # after a change was told, until the next one of the same thing is; doubled each time, up to
LONGEST_WAIT_S = 86_400.0
MOST_KEPT = 20_000  # things that are kept in mind: two of each meter of a large area


@dataclass(slots=True)
class _Thing:
    """Whether it ``holds``, since when that is so, and what the log says of it; before ``free_at`` it says no more."""

    holds: bool
    since: float
    is_told: bool = False
    free_at: float = float("-inf")
    wait_s: float = FIRST_WAIT_S


class ChangeLog:
    """Writes the ends of scans in which something has changed that may be told."""

    def __init__(self) -> None:
        self._things: dict[tuple[str, str], _Thing] = {}

    def take(self, end: Conclude, now: float) -> None:
        """What holds at an end; ``now``: monotonic time, s."""
        for told in end.told:
            self._things.setdefault(told, _Thing(False, now))
        news = [told for told, thing in self._things.items() if _is_news(thing, told in end.told, now)]
        if not news:
            return
        log.info("scan %d: %s", end.scan, end.text)
        for told in news:
            thing = self._things[told]
            thing.free_at, thing.wait_s = now + thing.wait_s, min(2 * thing.wait_s, LONGEST_WAIT_S)
        for thing in self._things.values():
            thing.is_told = thing.holds
        self._forget(now)

    def _forget(self, now: float) -> None:
        """Those that have been away for the longest, beyond ``MOST_KEPT``."""
        if len(self._things) > MOST_KEPT:
            kept = sorted(self._things.items(), key=lambda item: (not item[1].holds, now - item[1].since))
            self._things = dict(kept[:MOST_KEPT])


def _is_news(thing: _Thing, holds: bool, now: float) -> bool:
    """Note whether it ``holds``; whether the log says otherwise, and may be corrected."""
    if holds != thing.holds:
        if now - thing.since >= LONGEST_WAIT_S:
            thing.wait_s = FIRST_WAIT_S
            thing.free_at = min(thing.free_at, now)
        thing.holds, thing.since = holds, now
    return thing.holds != thing.is_told and now >= thing.free_at
