"""Playback of a recording on one of the two stages: the simulator, or processes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from coordinator.replay.process_stage import ProcessStage
from coordinator.replay.replay import Comparison, load_replay_areas, replay
from coordinator.replay.simulator_stage import SimulatorStage
from coordinator.replay.ticks import Tick
from scenarios.scenario import Scenario

OnScan = Callable[[Tick], None] | None


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
