"""Filter of the entries that are written into a recording, from the bus and from the simulator."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from agents.messages.checks import MessageError, should_log, shown
from agents.messages.keys import NAME, run_of, sender_of
from agents.messages.packing import CommandMessage, Message, ReadingsMessage, StateMessage, decode
from coordinator.watch.recording.entries import LEFT, MESSAGE, Entry, note
from coordinator.watch.recording.row_checks import check_recordable
from coordinator.watch.recording.segment_log import SegmentLog

REPEAT_S = 10.0  # of the messages that an area repeats without news, one is written per interval of this length
NUMBERS = re.compile(r"[0-9.]+")  # in notes: durations, which change from message to message
MOST_KEYS = 20_000  # whose last message is remembered; a sender may publish on any number of keys


class Recorder:
    """Writes to ``log`` the entries of run ``run`` that are new.

    ``rejected``: reason -> number of payloads that are no messages of this wire version, or whose sender is not that of
    their key.
    """

    def __init__(self, log: SegmentLog, run: str) -> None:
        self._log = log
        self._run = run
        self._last: dict[str, tuple[object, float]] = {}  # key -> gist of its last message, and when it was written
        self.rejected: Counter[str] = Counter()

    def take(self, entries: Sequence[Entry]) -> None:
        """Writes the new ones of ``entries``, in the order of their arrival."""
        if new := list(self._filter(entries)):
            self._log.write(new)

    def _filter(self, entries: Iterable[Entry]) -> Iterator[Entry]:
        for entry in entries:
            if entry.kind != MESSAGE:
                yield entry
                continue
            try:
                if self._is_new(entry):
                    yield entry
            except MessageError as error:
                self.rejected[error.reason] += 1
                if should_log(count := self.rejected[error.reason]):
                    yield note(entry.at, "rejected", reason=error.reason, count=count, key=entry.key[:200])

    def _is_new(self, entry: Entry) -> bool:
        """True where the content of a message is new, or was last written ``REPEAT_S`` ago or more.

        Raises:
            MessageError: the payload is no message, or its sender is not that of its key.
        """
        message = decode(entry.payload)
        check_sender(entry.key, message, self._run)
        gist, (last_gist, at) = _gist_of(message), self._last.get(entry.key, (None, 0.0))
        if gist == last_gist and abs(entry.at - at) < REPEAT_S:
            return False
        if entry.key in self._last or len(self._last) < MOST_KEYS:
            self._last[entry.key] = gist, entry.at
        return True


def check_sender(key: str, message: Message, run: str) -> None:
    """Checks that ``message`` belongs into a recording of ``run``, and that its sender is that of ``key``.

    Raises:
        MessageError: it is of another kind, run or sender, or its rows cannot be written.
    """
    is_own = sender_of(key) == message.header.sender or isinstance(message, CommandMessage)
    if not isinstance(message, StateMessage | ReadingsMessage | CommandMessage):
        raise MessageError("other kind", f"{message.kind} is no state, readings or command")
    if not is_own or run_of(key) != run or message.header.run != run:
        raise MessageError("unknown sender", "the message is of another sender than its key")
    if not isinstance(message, CommandMessage):
        if not NAME.fullmatch(message.header.sender):
            raise MessageError("unknown sender", f"{shown(message.header.sender)} is no name of an area")
        check_recordable(message)


def _gist_of(message: Message) -> object:
    """The part of a message that makes it new; fields that change from repeat to repeat are left out."""
    h = message.header
    quality = (message.quality, NUMBERS.sub("", "; ".join(message.notes))) if isinstance(message, StateMessage) else ()
    return h.incarnation, h.scan, h.sequence, quality


def left(at: float, key: str, reason: str) -> Entry:
    """The entry of a leave message."""
    return Entry(LEFT, at, key, reason.encode("ascii"))
