"""``python -m benchmarks.recorder_kills``: a recorder is killed again and again, and what its recording lacks.

A feeder in three areas makes scans all the time, and a listener beside the recorder notes what passes. Everything that
passed between the start of a recorder and the second before its end must be in the recording.
"""

from __future__ import annotations

import json
import os
import random
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import click

from agents.messages.keys import all_readings, all_states
from agents.messages.packing import ReadingsMessage, StateMessage, decode
from agents.security.access import COORDINATOR
from benchmarks.measuring.figures import figures_option, list_facts, write_section
from benchmarks.measuring.live_system import START_S, LiveSystem
from benchmarks.measuring.machine import describe_machine
from coordinator.recording.closing import close_ended
from coordinator.recording.folder import LOG, LOGS
from coordinator.recording.frames import is_being_written
from coordinator.recording.order import RECORDER
from coordinator.recording.parquet import read_rows
from coordinator.strategy_check import check_with_strategy
from scenarios.scenario import load_scenario

PACKAGES = ("eclipse-zenoh", "pyarrow")
SCENARIO = "ieee33"
SCAN_S = 0.25
LIFE_S = (1.5, 3.0)
MOST_LOST_S = 1.0

Said = tuple[str, str, int]
"""Table, area and scan."""


@dataclass(frozen=True)
class Life:
    """When a recorder began to listen, and when it was killed, s since 1970."""

    began: float
    killed: float


def kill_recorders(folder: Path, kills: int, seed: int) -> dict[str, object]:
    """What was seen, and what of it the recording lacks."""
    draws, passed = random.Random(seed), list[tuple[float, Said]]()
    scenario = check_with_strategy(load_scenario(SCENARIO))
    recording = folder / "recording"
    lives = []
    with LiveSystem(scenario, folder / "run", SCAN_S) as live, live.system.join(COORDINATOR) as session:
        for expression in (all_states("live"), all_readings("live")):
            session.subscribe(expression, lambda _, payload: _note(passed, payload))
        live.wait_until(lambda states: len(states) == len(scenario.partition.areas))
        live.system.start_recorder(recording, None, lambda: live.take() or None)
        for _ in range(kills):
            began = time.time()
            live.pass_time(draws.uniform(*LIFE_S))
            lives.append(Life(began, time.time()))
            live.system.kill(RECORDER)
            _wait(live, lambda: not _is_writing(recording))
            live.system.restart(RECORDER)
            _wait(live, lambda: _is_writing(recording))
    notes = close_ended(recording)
    recorded = _read(recording)
    heard = [find_heard(passed, life, recorded) for life in lives]
    missing = [[at for at, said in messages if said not in recorded] for messages in heard]
    lost_s = [life.killed - min(times) for life, times in zip(lives, missing, strict=True) if times]
    seen = [said for messages in heard for _, said in messages]
    return {
        "kills": kills,
        "messages while a recorder ran": len(seen),
        "scans of areas while a recorder ran": len({said for said in seen if said[0] == "readings"}),
        "lives that lost anything": len(lost_s),
        "longest that was lost before a kill, s": round(max(lost_s, default=0.0), 3),
        "damaged logs": [row for row in _events(recording) if row[0] == "damaged log" and "last frame" not in row[1]],
        "notes of closing": notes,
        "ended unasked": live.strays,
    }


def _note(passed: list[tuple[float, Said]], payload: bytes) -> None:
    message = decode(payload)
    if isinstance(message, StateMessage | ReadingsMessage) and message.header.scan:
        table = "states" if isinstance(message, StateMessage) else "readings"
        passed.append((time.time(), (table, message.header.sender, message.header.scan)))


def find_heard(passed: list[tuple[float, Said]], life: Life, recorded: set[Said]) -> list[tuple[float, Said]]:
    """What passed from the first message on that the recorder of ``life`` wrote, of each area and kind: before, the
    area did not know yet that it listens.
    """
    begun: set[tuple[str, str]] = set()
    heard = []
    for at, said in passed:
        if life.began <= at <= life.killed:
            if said in recorded:
                begun.add(said[:2])
            if said[:2] in begun:
                heard.append((at, said))
    return heard


def _is_writing(recording: Path) -> bool:
    return any(is_being_written(path) for path in (recording / LOGS).glob(f"*{LOG}"))


def _wait(live: LiveSystem, holds: object) -> None:
    assert callable(holds)
    if live.wait_until(lambda _: holds(), START_S) is None:
        raise RuntimeError(
            f"the recorder has not done so within {START_S:g} s; its log: {live.system.log_of(RECORDER)}"
        )


def _read(recording: Path) -> set[Said]:
    return {
        (table, area, scan)
        for table in ("states", "readings")
        for path in (recording / table).glob("*.parquet")
        for area, scan in read_rows(path, ["area", "scan"])
    }


def _events(recording: Path) -> list[tuple[str, str]]:
    paths = sorted((recording / "events").glob("*.parquet"))
    return [(event, details) for path in paths for event, details in read_rows(path, ["event", "details"])]


def find_failures(seen: dict[str, object]) -> list[str]:
    """What must not be."""
    lost_s = seen["longest that was lost before a kill, s"]
    assert isinstance(lost_s, float)
    checks = {
        f"more than the last {MOST_LOST_S:g} s is gone": lost_s <= MOST_LOST_S,
        "a log is damaged elsewhere than at its end": not seen["damaged logs"],
        "a log was not closed": not seen["notes of closing"],
        "a process ended unasked": not seen["ended unasked"],
        "nothing was recorded": bool(seen["scans of areas while a recorder ran"]),
    }
    return [failure for failure, good in checks.items() if not good]


@click.command(context_settings={"show_default": True})
@click.option("--kills", type=click.IntRange(min=1), default=100)
@click.option("--seed", type=click.IntRange(0), default=1)
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), help="Folder.  [default: temporary]")
@figures_option
def main(kills: int, seed: int, out: Path | None, figures: str | None) -> None:
    """Exit code 0: no more than the last second before each kill is gone; 1: more."""
    with tempfile.TemporaryDirectory() as scratch:
        machine, seen = describe_machine(PACKAGES), kill_recorders(out or Path(scratch), kills, seed)
    print(json.dumps(machine | seen, indent=2))
    failures = find_failures(seen)
    if figures:
        write_section(figures, machine, list_facts(seen | {"failures": "; ".join(failures) or "none"}))
    for failure in failures:
        print(f"error: {failure}", file=sys.stderr)
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.recorder_kills")
