"""The recording of a run on the simulator: times are those of its areas, and nothing is lost."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from agents.messages.keys import live_key, readings_key, state_key
from agents.messages.packing import NO_INCARNATION, ReadingsMessage, StateMessage, encode
from agents.protocol.configuration import Configuration
from coordinator.lab.simulator.subscriber import Subscriber
from coordinator.watch.recording.closing import close_recording, remove_oldest
from coordinator.watch.recording.entries import APPEARED, MESSAGE, VANISHED, Entry
from coordinator.watch.recording.folder import begin_writing
from coordinator.watch.recording.order import GIB
from coordinator.watch.recording.recorder import Recorder
from coordinator.watch.recording.segment_log import SegmentLog


class SimulatedRecording(Subscriber):
    """Writes the messages of areas into ``folder``. ``started_at``: time of virtual time 0, s since 1970."""

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
