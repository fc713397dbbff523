"""Subscribers to a simulation: they receive every message, state and presence, and change nothing. The recorder."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from agents.messages.keys import live_key, readings_key, state_key
from agents.messages.packing import NO_INCARNATION, Message, ReadingsMessage, StateMessage, encode
from agents.protocol.configuration import Configuration
from coordinator.watch.recording.closing import close_recording, remove_oldest
from coordinator.watch.recording.entries import APPEARED, MESSAGE, VANISHED, Entry
from coordinator.watch.recording.folder import GIB, begin_writing
from coordinator.watch.recording.recorder import Recorder
from coordinator.watch.recording.segment_log import SegmentLog


class Subscriber:
    """Receives every event of the simulated bus, in order. This base class ignores them."""

    def begin(self, run: str, files: Sequence[Configuration]) -> None:
        """Takes the name of the run and its area files, before all events."""

    def take_state(self, at: float, state: StateMessage) -> None:
        """Takes a state that an area has published at ``at``."""

    def take_readings(self, at: float, readings: ReadingsMessage) -> None:
        """Takes the readings that an area has used, published at ``at``."""

    def take_presence(self, at: float, area: str, alive: bool) -> None:
        """Takes the appearance or the end of an area's presence token."""

    def take_message(self, at: float, receiver: str, message: Message, arrives: bool) -> None:
        """Takes a message to a neighbour: once when it is sent, and again when it ``arrives``."""


class SimulatedRecording(Subscriber):
    """The recording of a simulation in ``folder``: its times are those of the areas, and nothing is lost.

    ``started_at``: time of virtual time 0, s since 1970.
    """

    def __init__(self, folder: Path, started_at: float, limit_gb: float | None) -> None:
        self._folder, self._started_at, self._run = folder, started_at, ""
        self._limit = limit_gb * GIB if limit_gb else None
        self._stack = ExitStack()
        self._recorder: Recorder | None = None

    def begin(self, run: str, files: Sequence[Configuration]) -> None:
        self._run = run
        self._stack.enter_context(begin_writing(self._folder, run, files))
        log = SegmentLog(self._folder, self._limit)
        self._stack.callback(log.close)
        self._recorder = Recorder(log, run)

    def take_state(self, at: float, state: StateMessage) -> None:
        self._take(MESSAGE, at, state_key(self._run, state.header.sender), encode(state))

    def take_readings(self, at: float, readings: ReadingsMessage) -> None:
        self._take(MESSAGE, at, readings_key(self._run, readings.header.sender), encode(readings))

    def take_presence(self, at: float, area: str, alive: bool) -> None:
        self._take(APPEARED if alive else VANISHED, at, live_key(self._run, "area", area, NO_INCARNATION))

    def close(self) -> None:
        """Ends the recording, closes its logs and keeps its limit. Later calls find nothing left to do."""
        with self._stack.pop_all():
            pass
        if self._recorder is None:
            return
        close_recording(self._folder)
        if self._limit:
            remove_oldest(self._folder, self._limit)

    def _take(self, kind: str, at: float, key: str, payload: bytes = b"") -> None:
        assert self._recorder is not None
        self._recorder.take([Entry(kind, self._started_at + at, key, payload)])
