"""The file of the next split, which lies beside the one in use: ``area1.next.toml`` beside ``area1.toml``.

It is looked for once a second and read on a thread of its own when it has not changed for one look, as copying takes a
while. The protocol learns of it and says when the area rests on it (``agents/protocol/events.py``, ``Offered``).
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from agents.protocol.configuration import Configuration
from agents.protocol.events import Offered
from agents.runtime.inbox import Inbox
from agents.strategies.installed import load_strategy
from dsse_core.errors import InvalidInputError
from dsse_core.printable import printable

log = logging.getLogger(__name__)
LOOK_S = 1.0  # between two looks at the folder
Look = tuple[int, int, int] | None  # size, time of the last change in ns, number of the file; None where there is none


class NextFile:
    """Of the area of ``content``, whose own file is ``path``; what is found is put into ``inbox``, read by ``load``."""

    def __init__(self, path: Path, content: Configuration, inbox: Inbox, load: Callable[[Path], Configuration]) -> None:
        self.path = path.with_name(f"{path.stem}.next{path.suffix}")
        self._own_path = path
        self._content, self._inbox, self._load = content, inbox, load
        self._next_look = 0.0
        self._seen: Look = None  # at the last look
        self._read: Look = None  # what was read last
        self._found: tuple[Look, Configuration | None] = (None, None)  # that, and what it holds

    def read_at_once(self) -> Configuration | None:
        """What lies there when the process begins."""
        self._seen = self._read = self._look()
        return self._offer() if self._read is not None else None

    @property
    def next_due(self) -> float:
        """When ``look`` has something to do, monotonic time, s."""
        return self._next_look

    def look(self, now: float) -> None:
        """See whether the file has come, gone or changed, at most once in ``LOOK_S``."""
        if now < self._next_look:
            return
        self._next_look = now + LOOK_S
        before, self._seen = self._seen, self._look()
        if self._seen == self._read or self._seen != before:
            return
        self._read = self._seen
        if self._read is None:
            self._inbox.put("next file", Offered(None))
        else:
            threading.Thread(target=self._offer, name="next file", daemon=True).start()

    def take_place(self, configuration: Configuration) -> None:
        """Put the file in the place of the one in use; the area rests on ``configuration`` now, which was read there.

        Another file that has come there since stays, and is read as that of the split after.
        """
        look, found = self._found
        if found is not configuration or look != self._look():
            self._seen = self._read = None
            what = f"{printable(str(self.path))} is not the file any more on which the area rests now"
            log.warning("%s: %s stays the former one, until the area goes over again", what, self._own_path.name)
            return
        try:
            os.replace(self.path, self._own_path)
        except OSError as error:
            what = f"{printable(str(self.path))} is in use now and cannot be moved, {error.strerror}: move it to"
            log.warning("%s %s by hand, or the agent begins with the former one", what, self._own_path.name)

    def _look(self) -> Look:
        try:
            found = self.path.stat()
        except OSError:
            return None
        return found.st_size, found.st_mtime_ns, found.st_ino

    def _offer(self) -> Configuration | None:
        """Read the file, and have the protocol learn of it."""
        found: Configuration | None = None
        look = self._read
        try:
            found = self._load(self.path)
            self._check(found)
        except InvalidInputError as error:
            found = None
            log.warning("the file of the next split cannot be used: %s", error)
        self._found = look, found
        self._inbox.put("next file", Offered(found))
        return found

    def _check(self, found: Configuration) -> None:
        """Raise InvalidInputError if the file is of another area or run, or no running agent can go over to it."""
        own = self._content
        pairs = (("area", found.area.name, own.area.name), ("run", found.run, own.run))
        problems = [
            f"{key}: is {printable(given)}; the file in use is of {known}"
            for key, given, known in pairs
            if given != known
        ]
        problems += load_strategy(found.strategy).find_ring_problems(found.strategy, [found.area])
        problems += _find_link_problems(own, found)
        if problems:
            raise InvalidInputError(f"area file {printable(str(self.path))}", problems)


def _find_link_problems(own: Configuration, following: Configuration) -> Iterator[str]:
    """Which direct links with neighbours ``following`` needs that ``own`` has not opened; a router serves any."""
    cure = "direct links open only when an agent starts: replace the files area by area, with restarts"
    if not (own.listen or following.listen):
        return
    if set(following.listen) != set(own.listen):
        yield f"listen: is {_listed(following.listen)}; the agent listens at {_listed(own.listen)}, and {cure}"
    if missing := sorted({*following.endpoints} - {*own.endpoints}):
        yield f"endpoints: the agent has no link with {_listed(missing)}, and {cure}"


def _listed(endpoints: Collection[str]) -> str:
    return printable(", ".join(endpoints)) or "no endpoint"
