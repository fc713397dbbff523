"""Playing a recording back on one of the stages there are."""

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
    """Play the recording at ``folder`` on the simulator; the arguments and errors are those of ``replay`` and
    ``load_replay_areas``.
    """
    files = load_replay_areas(folder, scenario)
    names = [content.area.name for content in files]
    return replay(folder, SimulatorStage(files), names, speed, on_scan or _ignore)


def play_on_processes(
    folder: Path, scenario: Scenario | None = None, speed: float | None = None, on_scan: OnScan = None
) -> Comparison:
    """The same on processes of its own, which end with it.

    Raises:
        TransportError: they do not start, or one dies.
    """
    files = load_replay_areas(folder, scenario)
    with ProcessStage(files) as stage:
        names = [content.area.name for content in files]
        return replay(folder, stage, names, speed, on_scan or _ignore)


def _ignore(tick: Tick) -> None:
    """Nobody wants to know."""
