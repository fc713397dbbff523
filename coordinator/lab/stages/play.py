"""Playback of a recording on one of the two stages: the simulator, or processes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from agents.area_files.area_file import stamp_split
from agents.messages.packing import Incarnation, StateMessage
from agents.protocol.configuration import Configuration
from coordinator.lab.deployment.split import area_files
from coordinator.lab.simulator.simulator import STARTED_AT, SimulatedBus
from coordinator.lab.stages.process_stage import ProcessStage
from coordinator.watch.recording.folder import load_areas, read_about
from coordinator.watch.replay.replay import Comparison, make_telemetry_message, replay
from coordinator.watch.replay.scan_states import ScanStates
from coordinator.watch.replay.ticks import Tick
from dsse_core.errors import InvalidInputError
from dsse_core.grid.measurement import Measurement
from dsse_core.link_faults import LinkFaults
from dsse_core.reading_rules import DEFAULT_RULES
from scenarios.scenario import Scenario

STEPS_PER_HEARTBEAT = 10
LONGEST_SCAN_S = 60.0  # of virtual time, for areas that do not come to rest: lossy links, false messages
QUIET_HEARTBEATS = 6  # without change, after which a state that is not good stays so


class _Bus(SimulatedBus):
    """A simulated bus whose plant reads a recording."""

    def next_scan(
        self,
        telemetry: Mapping[str, Sequence[Measurement]],
        late_s: Mapping[str, float] | None = None,
        measured_at: Mapping[str, float] | None = None,
    ) -> None:
        """Does nothing: the plant makes no scans of its own."""

    def play(self, tick: Tick) -> None:
        """Publishes the readings of ``tick``."""
        self.scan = tick.scan
        for name, snapshot in tick.readings.items():
            now = STARTED_AT + self.now
            run = self.files[name].run
            self._take_over(name, make_telemetry_message(run, name, tick.scan, snapshot, Incarnation(0, 0), now))


class SimulatorStage:
    """Plays scans to ``files`` on the simulator. ``on_state``: called with every state that an area shows."""

    def __init__(
        self, files: Sequence[Configuration], on_state: Callable[[float, StateMessage], None] = lambda at, state: None
    ) -> None:
        self._on_state = on_state
        self._states = ScanStates(0, 0.0)
        self._bus = _Bus(files, {}, self._take)
        self._heartbeat_s = min(content.beat_s for content in files)

    def play(self, tick: Tick) -> Mapping[str, StateMessage]:
        """Plays a scan, see ``Stage.play``. Areas without readings in it are not on the bus meanwhile."""
        for name in self._bus.files:
            if name not in tick.readings:
                self._bus.kill(name)
            elif name not in self._bus.protocols:
                self._bus.start(name)
        began = self._bus.now
        self._states = states = ScanStates(tick.scan, began)
        self._bus.play(tick)
        while not states.are_good(tick.readings) and self._bus.now - began < LONGEST_SCAN_S:
            self._bus.run(self._heartbeat_s / STEPS_PER_HEARTBEAT)
            if self._bus.now - states.changed_at > QUIET_HEARTBEATS * self._heartbeat_s:
                break
        return states.best

    def _take(self, at: float, state: StateMessage) -> None:
        self._on_state(at, state)
        self._states.take(at, state)


OnScan = Callable[[Tick, Mapping[str, StateMessage]], None] | None


def load_replay_areas(folder: Path, scenario: Scenario | None = None) -> list[Configuration]:
    """The area files of the recording at ``folder``, or of ``scenario`` if given, changed for a replay: default rules
    for readings, no clock error, no interval of scans, no cuts of links, whose times are those of the recorded run.

    Raises:
        InvalidInputError: ``folder`` is no recording, or has no area files and no scenario is given.
    """
    about = read_about(folder)
    files = load_areas(folder) if scenario is None else area_files(scenario, about.run, ["tcp/127.0.0.1:7447"])
    if not files:
        problem = "was recorded without its area files; give the scenario of the split: dsse replay FOLDER SCENARIO"
        raise InvalidInputError(str(folder), [problem])
    made = [replace(c, readings=DEFAULT_RULES, clock_error_s=0.0, scan_s=None, links=_uncut(c.links)) for c in files]
    return stamp_split(made, time.time())


def _uncut(links: Mapping[str, LinkFaults]) -> dict[str, LinkFaults]:
    return {neighbour: replace(faults, cuts=()) for neighbour, faults in links.items()}


def play_on_simulator(
    folder: Path, scenario: Scenario | None = None, speed: float | None = None, on_scan: OnScan = None
) -> Comparison:
    """Plays the recording at ``folder`` on the simulator. Arguments and errors are those of ``replay`` and
    ``load_replay_areas``.
    """
    files = load_replay_areas(folder, scenario)
    names = [content.area.name for content in files]
    return replay(folder, SimulatorStage(files), names, speed, on_scan or _ignore)


def play_on_processes(
    folder: Path, scenario: Scenario | None = None, speed: float | None = None, on_scan: OnScan = None
) -> Comparison:
    """Plays the recording at ``folder`` on processes, which end with the playback. Arguments and errors are those of
    ``replay`` and ``load_replay_areas``.

    Raises:
        TransportError: the processes do not start, or a process dies.
    """
    files = load_replay_areas(folder, scenario)
    with ProcessStage(files) as stage:
        names = [content.area.name for content in files]
        return replay(folder, stage, names, speed, on_scan or _ignore)


def _ignore(tick: Tick, states: Mapping[str, StateMessage]) -> None:
    """Does nothing."""
