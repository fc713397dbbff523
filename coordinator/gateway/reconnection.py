"""Doing again what has failed: after a pause that grows, with each error named once until it changes."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from dsse_core.printable import printable, shortened

log = logging.getLogger(__name__)
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 10.0
LONGEST_ERROR = 500  # characters


@dataclass
class Link:
    """What a source or sink is linked with. ``failures``: how often it has failed; ``error``: why last, empty while it
    works. ``say``: what to do with a sentence about that.
    """

    name: str
    failures: int = 0
    error: str = ""
    say: Callable[[str], None] = log.warning

    def note_success(self) -> None:
        """Something has come or gone through."""
        if self.error:
            self.say(f"{self.name} works again")
            self.error = ""

    def note_failure(self, error: BaseException) -> None:
        self.failures += 1
        if (found := describe_error(error)) != self.error:
            self.error = found
            self.say(f"{self.name}: {found}; trying again, in {FIRST_PAUSE_S:g} to {LONGEST_PAUSE_S:g} s")


async def keep_on(link: Link, attempt: Callable[[], Awaitable[None]]) -> None:
    """Await ``attempt()`` until it returns. After an error it is called again; a success of ``link`` in between makes
    the pause short again.
    """
    pause_s = FIRST_PAUSE_S
    while True:
        try:
            await attempt()
            return
        except Exception as error:  # whatever a foreign class or a library raises
            if not link.error:
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
