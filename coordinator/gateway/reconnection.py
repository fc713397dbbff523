"""Doing again what has failed: after a pause that grows, with each error named once until it changes."""

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
MOST_ERRORS = 50  # that are counted by themselves


@dataclass
class Link:
    """What a source or sink is linked with. ``failures``: how often it has failed; ``error``: why last, empty while it
    works. ``warn``: what to do with a sentence about that. ``clock``: monotonic, s.

    What works for less than ``LONGEST_PAUSE_S`` has not worked: of a link that comes and goes the 1st, 10th, 100th, ...
    failure is logged, and the pauses grow.
    """

    name: str
    failures: int = 0
    error: str = ""
    warn: Callable[[str], None] = log.warning
    clock: Callable[[], float] = time.monotonic
    _came_at: float = -math.inf  # when it began to work
    _gone: Counter[str] = field(default_factory=Counter)  # error -> how often it ended what had not worked for long
    _is_logged: bool = False

    def note_success(self) -> None:
        """Something has come or gone through."""
        if self.error:
            if self._is_logged:
                self.warn(f"{self.name} works again")
            self.error = ""
            self._came_at = self.clock()

    @property
    def has_worked(self) -> bool:
        """Whether it works, and has for long enough to be relied on."""
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
    """Await ``attempt()`` until it returns. After an error it is called again; where ``link`` has worked in
    between, the pause is short again.
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
    """In a line; of several at once the first."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    text = str(error) or (str(error.__cause__) if error.__cause__ else "")
    kind = type(error).__name__
    return printable(shortened(f"{text} ({kind})" if text else kind, LONGEST_ERROR).replace("\n", " "))
