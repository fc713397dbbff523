"""A simulated run that is played while it is computed: its playback grows at intervals."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from agents.messages.packing import Message
from coordinator.lab.simulator.simulate import Simulation
from coordinator.show.web.drawing import Drawing, draw_scenario, encode_drawing
from coordinator.show.web.playback.play import Play
from coordinator.show.web.playback.source import PlaybackSource
from coordinator.show.web.sources import BUSY_SHARE, Frame
from coordinator.watch.observe.grid_tables import Tables
from scenarios.scenario import Scenario

FIRST_LOOK_S = 0.02  # between two checks for the begin of the run
GROW_S = 1.0  # least time between two growths of the playback


class _AbandonedError(Exception):
    """The page of the run has been closed."""


class _Watched(Play):
    """A play that ends the simulation at its next message between areas once it ``is_abandoned``."""

    is_abandoned = False

    def take_message(self, at: float, receiver: str, message: Message, arrives: bool) -> None:
        if self.is_abandoned:
            raise _AbandonedError
        super().take_message(at, receiver, message, arrives)


class GrowingPlayback:
    """Source of a run of ``scenario`` on the simulator, to its verdict or its time limit, in a thread between ``start``
    and ``close``.

    ``on_complete``: called when the whole run can be played. Until then the last moments of the computed run are left
    out, because messages sent in them may still arrive.
    """

    mode = "playback"

    def __init__(self, scenario: Scenario, on_complete: Callable[[], object] = lambda: None) -> None:
        self._scenario, self._on_complete = scenario, on_complete
        self._play = _Watched()
        self._simulation = Simulation(scenario, subscriber=self._play)
        self._drawing = encode_drawing(draw_scenario(scenario), self.mode)
        self._began = threading.Event()
        self._over = threading.Event()
        self._failure: BaseException | None = None
        self._shown: PlaybackSource | None = None
        self._threads = [
            threading.Thread(target=self._simulate, name="simulation", daemon=True),
            threading.Thread(target=self._grow, name="growing playback", daemon=True),
        ]

    def start(self) -> None:
        """Starts the threads, and returns when the first moments can be played.

        Raises:
            Exception: the failure of the simulation, if it has failed before.
        """
        for thread in self._threads:
            thread.start()
        self._began.wait()
        if self._shown is None and self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Ends the threads. Waits until the simulation sends its next message between areas, or ends."""
        self._play.is_abandoned = True
        for thread in self._threads:
            thread.join()
        if self._shown is not None:
            self._shown.close()

    def _simulate(self) -> None:
        try:
            self._simulation.run()
        except _AbandonedError:
            pass
        except Exception as error:  # reported on the page, as a remark
            self._failure = error
        finally:
            self._over.set()

    def _grow(self) -> None:
        try:
            pause_s, is_over = 0.0, False
            while not is_over:
                is_over = self._over.wait(pause_s)
                began = time.monotonic()
                self._show(is_over)
                took_s = time.monotonic() - began
                pause_s = max(GROW_S, BUSY_SHARE * took_s) if self._shown else FIRST_LOOK_S
            if not self._play.is_abandoned:
                self._on_complete()
        except Exception as error:
            self._failure = error
        finally:
            self._began.set()

    def _show(self, is_over: bool) -> None:
        play = self._play if is_over else self._play.copy_settled()
        if not play.updates or self._play.is_abandoned:
            return
        computed_s = max(play.updates[-1][0], *(sent.at for sent in play.messages[-1:]), 0.0)
        remarks = () if is_over else (f"the simulation goes on: {computed_s:.3g} s of the run are computed",)
        if self._failure is not None:
            remarks = (f"the simulation has failed here: {self._failure}",)
        before = self._shown
        self._shown = PlaybackSource(play, self._scenario, remarks, drawing=self._drawing, is_complete=is_over)
        self._began.set()
        if before is not None:
            before.close()

    @property
    def _source(self) -> PlaybackSource:
        assert self._shown is not None, "started"
        return self._shown

    @property
    def newest(self) -> Frame:
        return self._source.newest

    @property
    def drawing(self) -> Drawing:
        return self._drawing

    def read_history(self, kind: str, name: str) -> dict[str, Any]:
        return self._source.read_history(kind, name)

    def tables(self, number: int | None = None) -> Tables:
        return self._source.tables(number)

    @property
    def since(self) -> float:
        return self._source.since

    def times(self) -> Sequence[float]:
        return self._source.times()

    @property
    def remarks(self) -> Sequence[str]:
        return self._source.remarks

    @property
    def is_complete(self) -> bool:
        return self._source.is_complete

    def frame(self, number: int) -> bytes:
        return self._source.frame(number)
