"""``events.jsonl``: the events of a run, one JSON object a line, written at once.

A part that has become large is followed by ``events-1.jsonl`` and so on. The first part, which names all processes of
the run, is kept, and so are the newest MOST_PARTS.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from dsse_core.files.whole_lines import WholeLines

PART_BYTES = 32 * 2**20  # of a part; `dsse stop` reads the first one whole
MOST_PARTS = 16  # beside the first


class EventLog:
    """Appends events to ``path``; ``time`` in each is seconds since ``started`` on the monotonic clock.

    A run goes on where its events cannot be written, on a full disk for instance. ``failure``: the first reason, None
    if all are written.
    """

    def __init__(self, path: Path, started: float, part_bytes: int = PART_BYTES, most_parts: int = MOST_PARTS) -> None:
        self.failure: str | None = None
        self._path = path
        self._part, self._part_bytes, self._most_parts = 0, part_bytes, most_parts
        self._started = started
        self._lines = WholeLines(path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._noting_failure():
            self._lines.close()

    def write(self, event: str, now: float | None = None, **details: Any) -> None:
        """Write one event that happened at monotonic time ``now`` (default: this moment)."""
        at = (time.monotonic() if now is None else now) - self._started
        with self._noting_failure():
            self._lines.append(json.dumps({"time": at, "event": event, **details}) + "\n")
            if self._lines.file.tell() >= self._part_bytes:
                self._begin_part()

    def _begin_part(self) -> None:
        former, self._lines = self._lines, WholeLines(self._name(self._part + 1))
        former.close()
        self._part += 1
        if self._part > self._most_parts:
            self._name(self._part - self._most_parts).unlink(missing_ok=True)

    def _name(self, part: int) -> Path:
        return self._path.with_stem(f"{self._path.stem}-{part}")

    @contextmanager
    def _noting_failure(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.failure = self.failure or f"{self._path}: {error.strerror}"
