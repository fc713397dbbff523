"""What a page shows: a running system, received in a thread of its own, or moments that were made before."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from coordinator.observe.grid_tables import GridTables
from coordinator.observe.watch import Watcher
from coordinator.web.drawing import Drawing, draw_scenario, draw_states, encode_drawing
from coordinator.web.moment import Moments, encode_json
from coordinator.web.shown_tables import Tables

UPDATE_S = 0.25  # between two moments, at least
BUSY_SHARE = 5  # making moments takes a fifth of the time at most, however large the grid
MOST_RATE = 2_000_000  # bytes a second to one reader

Look = Callable[[float], Watcher]


@dataclass(frozen=True)
class Frame:
    """A moment as it is sent: ``number`` grows with each."""

    number: int
    payload: bytes


class Source(Protocol):
    """``mode``: live or playback."""

    @property
    def mode(self) -> str: ...

    @property
    def newest(self) -> Frame: ...

    @property
    def drawing(self) -> Drawing:
        """What hardly changes; see ``/api/grid``."""
        ...

    def read_history(self, kind: str, name: str) -> dict[str, Any]:
        """Times and columns of one bus, branch, meter or area, empty if it is not known; ``complete``: whether that is
        all.
        """
        ...

    def tables(self, number: int | None = None) -> Tables:
        """Of the newest moment, or of the frame of that number."""
        ...

    @property
    def since(self) -> float:
        """What times count from, s since 1970; 0 where there was no such time."""
        ...

    def times(self) -> Sequence[float]:
        """Of the frames that can be asked for; none of a live source."""
        ...

    @property
    def remarks(self) -> Sequence[str]:
        """In words, what is not among them."""
        ...

    @property
    def is_complete(self) -> bool:
        """Whether there will be no more of them."""
        ...

    def frame(self, number: int) -> bytes:
        """One of them."""
        ...


class LiveSource:
    """What ``look`` receives, until ``close``; a thread makes a moment of it now and then.

    ``known``: the grid, if there is a scenario of it.
    """

    mode = "live"
    since = 0.0
    remarks = ()
    is_complete = True

    def __init__(self, look: Look, known: GridTables | None, run: str) -> None:
        self._look, self._known, self._run = look, known, run
        self._moments = Moments(known)
        self._lock = threading.Lock()  # of the history
        self._newest = Frame(0, encode_json({"number": 0, "mode": self.mode, "time": time.time()}))
        self._drawn: object = None  # what the drawing shows
        self._drawing = encode_drawing(draw_scenario(known.scenario) if known else draw_states(run, {}), self.mode)
        self._is_over = False
        self._thread = threading.Thread(target=self._go_on, name="watcher")

    def start(self) -> None:
        """Begin to receive."""
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
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
            if (began := time.monotonic()) < due:  # something has arrived before it is time for the next moment
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
        """Without a scenario the grid is what areas say of their buses; it is drawn anew once that changes."""
        if self._known is not None:
            return
        drawn = {name: (state.buses, tuple(state.sent)) for name, state in watcher.states.items()}
        if drawn != self._drawn:
            self._drawn = drawn
            self._drawing = encode_drawing(draw_states(self._run, watcher.states), self.mode)
