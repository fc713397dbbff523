"""The log of a process: printable lines, and facts about an area when they change.

A fact is logged when it begins and when it ends to hold, not in every scan. A fact that changes all the time is logged
ever more rarely, in the end once a day, so a log of months stays short. The change of a fact that was the same for a
day is logged at once.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from agents.protocol.events import Conclude
from dsse_core.printable import printable

log = logging.getLogger(__name__)
FIRST_WAIT_S = 10.0  # from one logged change of a fact to the next of the same fact; doubled each time, up to
LONGEST_WAIT_S = 86_400.0
MOST_KEPT = 20_000  # facts that are kept: two of each meter of a large area


class PrintableFormatter(logging.Formatter):
    """Escapes control characters, which a terminal would obey: names and notes in a record come from the bus."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The line of ``record``; the traceback of a defect, if there is one, follows on lines of its own."""
        return printable(super().formatMessage(record))


def start_log() -> None:
    """Log to standard error; for the entry points of processes. A log that cannot be written ends none of them."""
    logging.raiseExceptions = False
    handler = logging.StreamHandler()
    handler.setFormatter(PrintableFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


@dataclass(slots=True)
class _Fact:
    """State of a fact: whether it ``holds``, ``since`` when, and whether the log says so (``is_logged``).

    Its changes are not logged before ``free_at``; ``wait_s``: pause after the next logged change, s.
    """

    holds: bool
    since: float
    is_logged: bool = False
    free_at: float = float("-inf")
    wait_s: float = FIRST_WAIT_S


class ChangeLog:
    """Logs the end of a scan where a fact has changed and may be logged."""

    def __init__(self) -> None:
        self._facts: dict[tuple[str, str], _Fact] = {}

    def take(self, end: Conclude, now: float) -> None:
        """Take in the facts at the end of a scan, and log the end where one has changed; ``now``: monotonic time, s."""
        for name in end.facts:
            self._facts.setdefault(name, _Fact(False, now))
        changed = [name for name, fact in self._facts.items() if _has_changed(fact, name in end.facts, now)]
        if not changed:
            return
        log.info("scan %d: %s", end.scan, end.text)
        for name in changed:
            fact = self._facts[name]
            fact.free_at, fact.wait_s = now + fact.wait_s, min(2 * fact.wait_s, LONGEST_WAIT_S)
        for fact in self._facts.values():
            fact.is_logged = fact.holds
        self._forget(now)

    def _forget(self, now: float) -> None:
        """Drop facts beyond ``MOST_KEPT``: first those that have not held for the longest time."""
        if len(self._facts) > MOST_KEPT:
            kept = sorted(self._facts.items(), key=lambda item: (not item[1].holds, now - item[1].since))
            self._facts = dict(kept[:MOST_KEPT])


def _has_changed(fact: _Fact, holds: bool, now: float) -> bool:
    """Note whether the fact ``holds``; True where the log says otherwise, and may be corrected at ``now``."""
    if holds != fact.holds:
        if now - fact.since >= LONGEST_WAIT_S:
            fact.wait_s = FIRST_WAIT_S
            fact.free_at = min(fact.free_at, now)
        fact.holds, fact.since = holds, now
    return fact.holds != fact.is_logged and now >= fact.free_at
