"""The past of every bus, branch, meter and area of a play, computed in a thread from the first request on."""

from __future__ import annotations

import threading
from typing import Any

from coordinator.show.web.moment import Moments
from coordinator.show.web.playback.course import Course
from coordinator.watch.observe.grid_tables import GridTables
from scenarios.scenario import Scenario

PATIENCE_S = 1.0  # wait of a request for a past that is not complete yet


class PastOfPlay:
    """The past of the play of ``course``. A thread goes through it, because tables of thousands of buses are slow."""

    def __init__(self, course: Course, scenario: Scenario | None) -> None:
        self._course = course
        self._moments = Moments(GridTables(scenario) if scenario else None)
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._find, name="past of the play", daemon=True)
        self._beginning = threading.Lock()
        self._is_over = False

    def read(self, kind: str, name: str) -> dict[str, Any]:
        """Times and columns found after ``PATIENCE_S`` at most; ``complete``: True where the past is complete."""
        with self._beginning:
            if self._thread.ident is None:
                self._thread.start()
        self._thread.join(PATIENCE_S)
        is_complete = not self._thread.is_alive()
        with self._lock:
            return self._moments.history.read(kind, name) | {"complete": is_complete}

    def close(self) -> None:
        """Ends the computation of the past."""
        self._is_over = True

    def _find(self) -> None:
        for at, watcher in self._course.walk():
            if self._is_over:
                return
            with self._lock:
                self._moments.note(watcher, at, at)
