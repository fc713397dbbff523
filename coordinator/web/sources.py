"""What a page shows: a running system, received in a thread of its own, or moments that were made before."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from coordinator.observe.grid_tables import GridTables
from coordinator.observe.watch import Watcher
from coordinator.web.drawing import draw_scenario, draw_states
from coordinator.web.moment import Moments, encode_json

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

    def grid(self) -> dict[str, Any]:
        """What does not change; see ``/api/grid``."""
        ...

    def read_history(self, kind: str, name: str) -> dict[str, Any]:
        """Times and columns of one bus, branch, meter or area; empty if it is not known."""
        ...

    def times(self) -> Sequence[float]:
        """Of the frames that can be asked for; none of a live source."""
        ...

    def frame(self, number: int) -> bytes:
        """One of them."""
        ...


class LiveSource:
    """What ``look`` receives, until ``close``; a thread makes a moment of it now and then.

    ``known``: the grid, if there is a scenario of it.
    """

    mode = "live"

    def __init__(self, look: Look, known: GridTables | None, run: str) -> None:
        self._look, self._known, self._run = look, known, run
        self._moments = Moments(known)
        self._lock = threading.Lock()  # of the history
        self._newest = Frame(0, encode_json({"number": 0, "mode": self.mode, "time": time.time()}))
        self._grid = draw_scenario(known.scenario) if known else draw_states(run, {})
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

    def grid(self) -> dict[str, Any]:
        return self._grid

    def read_history(self, kind: str, name: str) -> dict[str, Any]:
        key: Any = int(name) if kind == "bus" else name
        with self._lock:
            return self._moments.history.of[kind].read(key)

    def times(self) -> Sequence[float]:
        return ()

    def frame(self, number: int) -> bytes:
        raise LookupError(f"a live page has no frame {number}")

    def _go_on(self) -> None:
        wait_s = UPDATE_S
        while not self._is_over:
            watcher = self._look(wait_s)
            began = time.monotonic()
            with self._lock:
                self._take(watcher, began)
            took_s = time.monotonic() - began
            wait_s = max(UPDATE_S, BUSY_SHARE * took_s, len(self._newest.payload) / MOST_RATE)

    def _take(self, watcher: Watcher, now: float) -> None:
        if self._known is None:
            self._grid = draw_states(self._run, watcher.states)
        number, at = self._newest.number + 1, time.time()
        moment = self._moments.make(watcher, now, at, number=number, mode=self.mode, time=at)
        self._newest = Frame(number, encode_json(moment))


class PlaybackSource:
    """Moments that were made before, to be looked at in any order."""

    mode = "playback"

    def __init__(self, grid: dict[str, Any], moments: Moments, frames: Sequence[tuple[float, bytes]]) -> None:
        self._grid, self._moments, self._frames = grid, moments, frames

    @property
    def newest(self) -> Frame:
        return Frame(len(self._frames), self._frames[-1][1])

    def grid(self) -> dict[str, Any]:
        return self._grid

    def read_history(self, kind: str, name: str) -> dict[str, Any]:
        key: Any = int(name) if kind == "bus" else name
        return self._moments.history.of[kind].read(key)

    def times(self) -> Sequence[float]:
        return [at for at, _ in self._frames]

    def frame(self, number: int) -> bytes:
        return self._frames[number][1]
