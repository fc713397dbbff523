"""Sources of a page: a running system, received in a thread, or the moments of a playback."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from coordinator.show.web.drawing import Drawing, draw_scenario, draw_states, encode_drawing
from coordinator.show.web.moment import Moments, encode_json
from coordinator.watch.observe.causes import Onsets
from coordinator.watch.observe.grid_tables import GridTables, Tables
from coordinator.watch.observe.watcher import Watcher

UPDATE_S = 0.25  # least time between two moments
BUSY_SHARE = 5  # the pause between two moments is at least this multiple of the time for making a moment
MOST_RATE = 2_000_000  # bytes a second to one reader

WatcherAt = Callable[[float], Watcher]


@dataclass(frozen=True)
class Frame:
    """A moment as it is sent. ``number`` grows from frame to frame."""

    number: int
    payload: bytes


class Source(Protocol):
    """Interface of a source. ``mode``: live or playback."""

    @property
    def mode(self) -> str: ...

    @property
    def newest(self) -> Frame: ...

    @property
    def drawing(self) -> Drawing:
        """The drawing of the grid, which rarely changes; see ``/api/grid``."""
        ...

    def read_history(self, kind: str, name: str) -> dict[str, Any]:
        """Times and columns of a bus, branch, meter or area, empty if it is not known.

        ``complete``: False where more of them will be found.
        """
        ...

    def tables(self, number: int | None = None) -> Tables:
        """Tables of the newest moment, or of the frame ``number``."""
        ...

    @property
    def since(self) -> float:
        """Origin of the times of frames, s since 1970; 0 where they have no such origin."""
        ...

    def times(self) -> Sequence[float]:
        """Times of the frames, s from ``since``; a live source has none."""
        ...

    @property
    def remarks(self) -> Sequence[str]:
        """Sentences on parts of the run that the frames lack."""
        ...

    @property
    def is_complete(self) -> bool:
        """True where no frames will be added."""
        ...

    def frame(self, number: int) -> bytes:
        """The frame ``number``, encoded.

        Raises:
            LookupError: there is no such frame.
        """
        ...


class LiveSource:
    """Source of the messages that ``look`` receives until ``close``. A thread makes moments of them at intervals.

    ``known``: the grid, if its scenario is known.
    """

    mode = "live"
    since = 0.0
    remarks = ()
    is_complete = True

    def __init__(self, look: WatcherAt, known: GridTables | None, run: str) -> None:
        self._look, self._known, self._run = look, known, run
        self._moments = Moments(known, Onsets())
        self._lock = threading.Lock()  # of the history
        self._newest = Frame(0, encode_json({"number": 0, "mode": self.mode, "time": time.time()}))
        self._drawn: object = None  # buses and neighbours that the drawing shows
        self._drawing = encode_drawing(draw_scenario(known.scenario) if known else draw_states(run, {}), self.mode)
        self._is_over = False
        self._thread = threading.Thread(target=self._go_on, name="watcher")

    def start(self) -> None:
        """Starts the thread that receives."""
        self._thread.start()

    def close(self) -> None:
        """Ends the thread."""
        self._is_over = True
        self._thread.join()

    @property
    def newest(self) -> Frame:
        return self._newest

    @property
    def drawing(self) -> Drawing:
        return self._drawing

    def read_history(self, kind: str, name: str) -> dict[str, Any]:
        with self._lock:
            return self._moments.history.read(kind, name) | {"complete": True}

    def tables(self, number: int | None = None) -> Tables:
        return self._moments.tables

    def times(self) -> Sequence[float]:
        return ()

    def frame(self, number: int) -> bytes:
        raise LookupError(f"a live page has no frame {number}")

    def _go_on(self) -> None:
        due = time.monotonic()
        while not self._is_over:
            watcher = self._look(max(0.0, min(UPDATE_S, due - time.monotonic())))
            if (began := time.monotonic()) < due:  # a message has arrived before the next moment is due
                continue
            with self._lock:
                self._take(watcher, began)
            ended = time.monotonic()
            due = ended + max(UPDATE_S, BUSY_SHARE * (ended - began), len(self._newest.payload) / MOST_RATE)

    def _take(self, watcher: Watcher, now: float) -> None:
        self._draw_anew(watcher)
        number, at, version = self._newest.number + 1, time.time(), self._drawing.version
        moment = self._moments.make(watcher, now, at, number=number, grid_version=version, mode=self.mode, time=at)
        self._newest = Frame(number, encode_json(moment))

    def _draw_anew(self, watcher: Watcher) -> None:
        """Draws the grid again if buses or neighbours in the states have changed; with a scenario it is constant."""
        if self._known is not None:
            return
        drawn = {name: (state.buses, state.phases, tuple(state.sent)) for name, state in watcher.states.items()}
        if drawn != self._drawn:
            self._drawn = drawn
            self._drawing = encode_drawing(draw_states(self._run, watcher.states), self.mode)
