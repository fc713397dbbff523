"""``python -m benchmarks.recorder_kills``: gaps in a recording whose recorder is killed again and again.

A feeder in three areas makes scans all the time, and a listener beside the recorder notes the messages. Every message
between the start of a recorder and the second before its end must be in the recording.
"""

from __future__ import annotations

import os
import random
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import click

from agents.security.access import COORDINATOR
from benchmarks.measuring.figures import conclude, figures_option
from benchmarks.measuring.live_system import START_S, LiveSystem
from benchmarks.measuring.machine import describe_machine
from benchmarks.measuring.recorded import Published, read_recorded, subscribe
from coordinator.lab.strategy_check import check_with_strategy
from coordinator.watch.recording.closing import close_ended
from coordinator.watch.recording.folder import LOG, LOGS, RECORDER
from coordinator.watch.recording.frames import is_being_written
from coordinator.watch.recording.parquet import read_rows
from scenarios.scenario import load_scenario

PACKAGES = ("eclipse-zenoh", "pyarrow")
SCENARIO = "ieee33"
SCAN_S = 0.25
RUN_S = (1.5, 3.0)
MOST_LOST_S = 1.0


@dataclass(frozen=True)
class RecorderRun:
    """Times at which a recorder began to listen and was killed, s since 1970."""

    began: float
    killed: float


def kill_recorders(folder: Path, kills: int, seed: int) -> dict[str, object]:
    """Figures of ``kills`` killed recorders: messages that passed, and those that the recording lacks."""
    draws, passed = random.Random(seed), list[tuple[float, Published]]()
    scenario = check_with_strategy(load_scenario(SCENARIO))
    recording = folder / "recording"
    runs = []
    with LiveSystem(scenario, folder / "run", SCAN_S) as live, live.system.join(COORDINATOR) as session:
        subscribe(session, "live", lambda published: passed.append((time.time(), published)))
        live.wait_until(lambda states: len(states) == len(scenario.partition.areas))
        live.system.start_recorder(recording, None, lambda: live.take() or None)
        for _ in range(kills):
            began = time.time()
            live.pass_time(draws.uniform(*RUN_S))
            runs.append(RecorderRun(began, time.time()))
            live.system.kill(RECORDER)
            _wait(live, lambda: not _is_writing(recording))
            live.system.restart(RECORDER)
            _wait(live, lambda: _is_writing(recording))
    notes = close_ended(recording)
    recorded = read_recorded(recording)
    due = [find_due(passed, run, recorded) for run in runs]
    missing = [[at for at, passed_on in messages if passed_on not in recorded] for messages in due]
    lost_s = [run.killed - min(times) for run, times in zip(runs, missing, strict=True) if times]
    seen = [passed_on for messages in due for _, passed_on in messages]
    return {
        "kills": kills,
        "messages while a recorder ran": len(seen),
        "scans of areas while a recorder ran": len({passed_on for passed_on in seen if passed_on[0] == "readings"}),
        "recorders that lost anything": len(lost_s),
        "messages lost before one that was not": sum(count_holes(messages, recorded) for messages in due),
        "longest that was lost before a kill, s": round(max(lost_s, default=0.0), 3),
        "damaged logs": [row for row in _events(recording) if row[0] == "damaged log" and "last frame" not in row[1]],
        "notes of closing": notes,
        "ended unasked": live.strays,
    }


def find_due(
    passed: list[tuple[float, Published]], run: RecorderRun, recorded: set[Published]
) -> list[tuple[float, Published]]:
    """Messages of an area and kind that passed during ``run``, from the first on that the recorder wrote.

    Before that message the area did not know yet that the recorder listens.
    """
    begun: set[tuple[str, str]] = set()
    due = []
    for at, passed_on in passed:
        if run.began <= at <= run.killed:
            if passed_on in recorded:
                begun.add(passed_on[:2])
            if passed_on[:2] in begun:
                due.append((at, passed_on))
    return due


def count_holes(due: list[tuple[float, Published]], recorded: set[Published]) -> int:
    """Number of missing messages before a present one of the same area and kind: a kill only cuts off the end."""
    missing, holes = Counter[tuple[str, str]](), 0
    for _, said in due:
        if said not in recorded:
            missing[said[:2]] += 1
        else:
            holes += missing.pop(said[:2], 0)
    return holes


def _is_writing(recording: Path) -> bool:
    return any(is_being_written(path) for path in (recording / LOGS).glob(f"*{LOG}"))


def _wait(live: LiveSystem, holds: object) -> None:
    assert callable(holds)
    if live.wait_until(lambda _: holds(), START_S) is None:
        raise RuntimeError(
            f"the recorder has not done so within {START_S:g} s; its log: {live.system.log_of(RECORDER)}"
        )


def _events(recording: Path) -> list[tuple[str, str]]:
    paths = sorted((recording / "events").glob("*.parquet"))
    return [(event, details) for path in paths for event, details in read_rows(path, ["event", "details"])]


def find_failures(seen: dict[str, object]) -> list[str]:
    """Requirements that the figures ``seen`` do not meet."""
    lost_s = seen["longest that was lost before a kill, s"]
    assert isinstance(lost_s, float)
    checks = {
        f"more than the last {MOST_LOST_S:g} s is gone": lost_s <= MOST_LOST_S,
        "something is missing before what is there": not seen["messages lost before one that was not"],
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
    conclude(machine, seen, find_failures(seen), figures)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.recorder_kills")
