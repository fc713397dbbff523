"""The past of every bus, branch, meter and area of a play: found beside the page once somebody asks for it."""

from __future__ import annotations

import threading
from typing import Any

from coordinator.observe.grid_tables import GridTables
from coordinator.web.moment import Moments
from coordinator.web.playback.course import Course
from scenarios.scenario import Scenario

PATIENCE_S = 1.0  # of who asks, with a past that is not complete yet


class PastOfPlay:
    """Of ``course``; a thread of its own goes through it, as tables of thousands of buses take their time."""

    def __init__(self, course: Course, scenario: Scenario | None) -> None:
        self._course = course
        self._moments = Moments(GridTables(scenario) if scenario else None)
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._find, name="past of the play", daemon=True)
        self._beginning = threading.Lock()
        self._is_over = False

    def read(self, kind: str, name: str) -> dict[str, Any]:
        """Times and columns, as far as they are found after a short while; whether that is ``complete``."""
        with self._beginning:
            if self._thread.ident is None:
                self._thread.start()
        self._thread.join(PATIENCE_S)
        is_complete = not self._thread.is_alive()
        with self._lock:
            return self._moments.history.read(kind, name) | {"complete": is_complete}

    def close(self) -> None:
        """Go no further."""
        self._is_over = True

    def _find(self) -> None:
        for at, watcher in self._course.walk():
            if self._is_over:
                return
            with self._lock:
                self._moments.note(watcher, at, at)
