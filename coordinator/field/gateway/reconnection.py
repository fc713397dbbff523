"""Reconnection of sources and sinks: retries after a pause that grows, with each error logged once until it changes."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

from agents.messages.checks import should_log
from dsse_core.printable import printable, shortened

log = logging.getLogger(__name__)
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 10.0
LONGEST_ERROR = 500  # characters
MOST_ERRORS = 50  # that are counted separately


@dataclass
class Link:
    """Link of a source or sink. ``failures``: their number; ``error``: the last one, empty while the link works.
    ``warn``: called with a sentence about a failure. ``clock``: monotonic, s.

    A link counts as working after ``LONGEST_PAUSE_S``. Of a link that fails again before that, the 1st, 10th, 100th,
    ... failure is logged, and the pauses grow.
    """

    name: str
    failures: int = 0
    error: str = ""
    warn: Callable[[str], None] = log.warning
    clock: Callable[[], float] = time.monotonic
    _came_at: float = -math.inf  # when it began to work
    _gone: Counter[str] = field(default_factory=Counter)  # error -> number of times, since the link has last worked
    _is_logged: bool = False

    def note_success(self) -> None:
        """Note that a reading or result has passed the link."""
        if self.error:
            if self._is_logged:
                self.warn(f"{self.name} works again")
            self.error = ""
            self._came_at = self.clock()

    @property
    def has_worked(self) -> bool:
        """True where the link has worked for ``LONGEST_PAUSE_S``."""
        return not self.error and self.clock() - self._came_at >= LONGEST_PAUSE_S

    def note_failure(self, error: BaseException) -> None:
        self.failures += 1
        if (found := describe_error(error)) == self.error:
            return
        if self.has_worked:
            self._gone.clear()
        found_as = found if found in self._gone or len(self._gone) < MOST_ERRORS else ""
        self._gone[found_as] += 1
        self.error = found
        self._is_logged = should_log(self._gone[found_as])
        if self._is_logged:
            self.warn(f"{self.name}: {found}; trying again, in {FIRST_PAUSE_S:g} to {LONGEST_PAUSE_S:g} s")


async def keep_on(link: Link, attempt: Callable[[], Awaitable[None]]) -> None:
    """Await ``attempt()`` until it returns; after an error, call it again after a pause that doubles each time.

    The pause begins at ``FIRST_PAUSE_S`` again once ``link`` has worked.
    """
    pause_s = FIRST_PAUSE_S
    while True:
        try:
            await attempt()
            return
        except Exception as error:  # whatever a foreign class or a library raises
            if link.has_worked:
                pause_s = FIRST_PAUSE_S
            link.note_failure(error)
        await asyncio.sleep(pause_s)
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)


def describe_error(error: BaseException) -> str:
    """The error in one line; of a group, its first error."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    text = str(error) or (str(error.__cause__) if error.__cause__ else "")
    kind = type(error).__name__
    return printable(shortened(f"{text} ({kind})" if text else kind, LONGEST_ERROR).replace("\n", " "))
