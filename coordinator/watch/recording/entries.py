"""Entries of a log, one in each frame: a payload as it came from the bus, a presence token, or a recorder's note."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec

from coordinator.watch.recording.frames import Gap, read_frames

MESSAGE, APPEARED, VANISHED, LEFT, NOTE = "message", "appeared", "vanished", "left", "note"


class Entry(msgspec.Struct, frozen=True, array_like=True):
    """An entry of a log.

    ``at``: time of its arrival, s since 1970 by the clock of the recorder. ``key``: its key on the bus; of a note, its
    event. ``payload``: the bytes of a message; of ``LEFT``, the reason in ASCII; of a note, its details in JSON.
    """

    kind: str
    at: float
    key: str
    payload: bytes = b""


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Entry)


def encode_entry(entry: Entry) -> bytes:
    return _encoder.encode(entry)


def note(at: float, event: str, **details: object) -> Entry:
    """A note of the recorder itself: an event and its details."""
    return Entry(NOTE, at, event, msgspec.json.encode(details))


def read_entries(path: Path) -> Iterator[Entry | str]:
    """The entries of the log at ``path`` in order, and a text in the place of each part that is lost.

    Raises:
        InvalidInputError: the file cannot be read, or is no log.
    """
    for found in read_frames(path):
        if isinstance(found, Gap):
            yield str(found)
            continue
        try:
            yield _decoder.decode(found)
        except (msgspec.MsgspecError, RecursionError) as error:
            yield f"no entry of this version: {error}"
