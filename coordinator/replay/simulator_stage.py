"""A recording on the simulator: as fast as it computes, repeatable to the bit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from agents.area_files.area_file import AreaFile
from agents.messages.packing import Incarnation, StateMessage
from agents.protocol.quality import GOOD
from coordinator.replay.replay import is_at_rest, make_telemetry_message
from coordinator.replay.ticks import Tick
from coordinator.simulator.simulator import STARTED_AT, SimulatedBus
from dsse_core.grid.measurement import Measurement

STEPS_PER_HEARTBEAT = 10
LONGEST_SCAN_S = 60.0  # of virtual time, for areas that come to no rest: lossy links, liars
QUIET_HEARTBEATS = 6  # after which a state that is not good stays so


class _Bus(SimulatedBus):
    """One whose plant reads a recording."""

    def next_scan(
        self,
        telemetry: Mapping[str, Sequence[Measurement]],
        late_s: Mapping[str, float] | None = None,
        measured_at: Mapping[str, float] | None = None,
    ) -> None:
        """None of its own."""

    def play(self, tick: Tick) -> None:
        """Say the readings of ``tick``."""
        self.scan = tick.scan
        for name, snapshot in tick.readings.items():
            now = STARTED_AT + self.now
            run = self.files[name].run
            self._take_over(name, make_telemetry_message(run, name, tick.scan, snapshot, Incarnation(0, 0), now))


class SimulatorStage:
    """Plays scans to ``files`` on the simulator. ``on_state``: called with every state that an area shows."""

    def __init__(
        self, files: Sequence[AreaFile], on_state: Callable[[float, StateMessage], None] = lambda at, state: None
    ) -> None:
        self._on_state = on_state
        self._best: dict[str, StateMessage] = {}  # of this scan: the last good state, else the last
        self._changed_at = 0.0
        self._bus = _Bus(files, {}, self._take)
        self._beat_s = min(content.beat_s for content in files)

    def play(self, tick: Tick) -> Mapping[str, StateMessage]:
        """As ``Stage.play``; areas without readings are not there meanwhile."""
        for name in self._bus.files:
            if name not in tick.readings:
                self._bus.kill(name)
            elif name not in self._bus.protocols:
                self._bus.start(name)
        self._best = {}
        self._bus.play(tick)
        self._changed_at = began = self._bus.now
        while self._bus.now - began < LONGEST_SCAN_S:
            self._bus.run(self._beat_s / STEPS_PER_HEARTBEAT)
            if is_at_rest((self._best.get(name) for name in tick.readings), tick.scan):
                break
            if self._bus.now - self._changed_at > QUIET_HEARTBEATS * self._beat_s:
                break
        return dict(self._best)

    def _take(self, at: float, state: StateMessage) -> None:
        self._on_state(at, state)
        last = self._best.get(state.header.sender)
        if last is None or last.header.order != state.header.order or last.quality != state.quality:
            self._changed_at = at
        is_better = last is None or state.quality == GOOD or last.quality != GOOD
        if state.header.scan == self._bus.scan and is_better:
            self._best[state.header.sender] = state
