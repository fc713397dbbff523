"""``events.jsonl``: what happened in a run, one JSON object a line, written at once."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from dsse_core.files.whole_lines import WholeLines


class EventLog:
    """Appends events to ``path``; ``time`` in each is seconds since ``started`` on the monotonic clock.

    A run does not end because its events cannot be written, on a full disk for instance: ``failure`` says why they
    could not be.
    """

    def __init__(self, path: Path, started: float) -> None:
        self.failure: str | None = None
        self._path = path
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

    @contextmanager
    def _noting_failure(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.failure = self.failure or f"{self._path}: {error.strerror}"
