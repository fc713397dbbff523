"""Playback of a recording on one of the two stages: the simulator, or processes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from agents.area_files.split_digest import stamp_split
from agents.protocol.configuration import Configuration
from coordinator.lab.deployment.split import area_files
from coordinator.lab.stages.process_stage import ProcessStage
from coordinator.lab.stages.simulator_stage import SimulatorStage
from coordinator.watch.recording.folder import load_areas, read_about
from coordinator.watch.replay.replay import Comparison, replay
from coordinator.watch.replay.ticks import Tick
from dsse_core.errors import InvalidInputError
from dsse_core.reading_rules import DEFAULT_RULES
from scenarios.scenario import Scenario

OnScan = Callable[[Tick], None] | None


def load_replay_areas(folder: Path, scenario: Scenario | None = None) -> list[Configuration]:
    """The area files of the recording at ``folder``, or of ``scenario`` if given, changed for a replay: default rules
    for readings, no clock error, no interval of scans.

    Raises:
        InvalidInputError: ``folder`` is no recording, or has no area files and no scenario is given.
    """
    about = read_about(folder)
    files = load_areas(folder) if scenario is None else area_files(scenario, about.run, ["tcp/127.0.0.1:7447"])
    if not files:
        problem = "was recorded without its area files; say by --scenario what the areas were split from"
        raise InvalidInputError(str(folder), [problem])
    made = [replace(c, readings=DEFAULT_RULES, clock_error_s=0.0, scan_s=None) for c in files]
    return stamp_split(made, time.time())


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


def _ignore(tick: Tick) -> None:
    """Does nothing."""
