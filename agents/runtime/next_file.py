"""The file of the next split, which lies beside the one in use: ``area1.next.toml`` beside ``area1.toml``.

The agent looks for the file once a second. It reads the file on a thread of its own when two looks have found it
unchanged, as copying takes a while. The protocol learns of the file and tells when the area goes over to it
(``agents/protocol/events.py``, ``Offered`` and ``GoOver``).
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
FileStamp = tuple[int, int, int] | None  # size, time of the last change in ns, number; None where there is no file


class NextFile:
    """Watches the next file of the area of ``content``, whose own file is ``path``.

    ``load`` reads the file; its configuration is put into ``inbox`` as ``Offered``.
    """

    def __init__(self, path: Path, content: Configuration, inbox: Inbox, load: Callable[[Path], Configuration]) -> None:
        self.path = path.with_name(f"{path.stem}.next{path.suffix}")
        self._own_path = path
        self._content, self._inbox, self._load = content, inbox, load
        self._next_look = 0.0
        self._seen: FileStamp = None  # at the last look
        self._read: FileStamp = None  # of the file that was read last
        self._reading: threading.Thread | None = None
        self._found: tuple[FileStamp, Configuration | None] = (None, None)  # the same, and its configuration

    def read_at_once(self) -> Configuration | None:
        """Configuration in the file that lies there when the process begins; None without a usable one."""
        self._seen = self._read = self._look()
        return self._offer() if self._read is not None else None

    @property
    def next_due(self) -> float:
        """Time of the next ``look``, monotonic, s."""
        return self._next_look

    def look(self, now: float) -> None:
        """Look whether the file has come, gone or changed, at most once in ``LOOK_S``; read a changed one."""
        if now < self._next_look:
            return
        self._next_look = now + LOOK_S
        before, self._seen = self._seen, self._look()
        if self._seen == self._read or self._seen != before:
            return
        if self._reading and self._reading.is_alive():
            return  # files are read one after the other, so that the newest is offered last
        self._read = self._seen
        if self._read is None:
            self._inbox.put("next file", Offered(None))
        else:
            self._reading = threading.Thread(target=self._offer, name="next file", daemon=True)
            self._reading.start()

    def take_place(self, configuration: Configuration) -> None:
        """Move the file to the place of the one in use; the area rests on its ``configuration`` now.

        Another file that has come there since stays, and is read as the file of the split after.
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

    def _look(self) -> FileStamp:
        try:
            found = self.path.stat()
        except OSError:
            return None
        return found.st_size, found.st_mtime_ns, found.st_ino

    def _offer(self) -> Configuration | None:
        """Read the file and offer its configuration to the protocol, or None where it cannot be used."""
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
        """Raise InvalidInputError if the file is of another area or run, or if this agent cannot go over to it."""
        own = self._content
        pairs = (("area", found.area.name, own.area.name), ("run", found.run, own.run))
        problems = [
            f"{key}: is {printable(given)}; the file in use is of {known}"
            for key, given, known in pairs
            if given != known
        ]
        problems += load_strategy(found.strategy).find_area_problems(found.strategy, [found.area])
        problems += _find_link_problems(own, found)
        if problems:
            raise InvalidInputError(f"area file {printable(str(self.path))}", problems)


def _find_link_problems(own: Configuration, following: Configuration) -> Iterator[str]:
    """Problems of direct links that ``following`` needs and ``own`` has not opened; a router serves any neighbours."""
    cure = "direct links open only when an agent starts: replace the files area by area, with restarts"
    if not (own.listen or following.listen):
        return
    if set(following.listen) != set(own.listen):
        yield f"listen: is {_listed(following.listen)}; the agent listens at {_listed(own.listen)}, and {cure}"
    if missing := sorted({*following.endpoints} - {*own.endpoints}):
        yield f"endpoints: the agent has no link with {_listed(missing)}, and {cure}"


def _listed(endpoints: Collection[str]) -> str:
    return printable(", ".join(endpoints)) or "no endpoint"
