"""The file of the next split, which lies beside the one in use: ``area1.next.toml`` beside ``area1.toml``.

It is looked for once a second and read on a thread of its own when it has not changed for one look, as copying takes a
while. The protocol learns of it and says when the area rests on it (``agents/protocol/events.py``, ``Offered``).
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from pathlib import Path

from agents.protocol.configuration import Configuration
from agents.protocol.events import Offered
from agents.runtime.inbox import Inbox
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

    def take_place(self) -> None:
        """Put the file in the place of the one in use, as the area rests on it now."""
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
        try:
            found = self._load(self.path)
            self._check(found)
        except InvalidInputError as error:
            found = None
            log.warning("the file of the next split cannot be used: %s", error)
        self._inbox.put("next file", Offered(found))
        return found

    def _check(self, found: Configuration) -> None:
        """Raise InvalidInputError if the file is of another area or run."""
        own = self._content
        pairs = (("area", found.area.name, own.area.name), ("run", found.run, own.run))
        problems = [
            f"{key}: is {printable(given)}; the file in use is of {known}"
            for key, given, known in pairs
            if given != known
        ]
        if problems:
            raise InvalidInputError(f"area file {printable(str(self.path))}", problems)
