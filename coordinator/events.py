"""``events.jsonl``: what happened in a run, one JSON object a line, written at once."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self


class EventLog:
    """Appends events to ``path``; ``time`` in each is seconds since ``started`` on the monotonic clock."""

    def __init__(self, path: Path, started: float) -> None:
        self._started = started
        self._file = path.open("a", encoding="utf-8")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def write(self, event: str, now: float | None = None, **details: Any) -> None:
        """Write one event that happened at monotonic time ``now`` (default: this moment)."""
        at = (time.monotonic() if now is None else now) - self._started
        self._file.write(json.dumps({"time": round(at, 4), "event": event, **details}) + "\n")
        self._file.flush()
