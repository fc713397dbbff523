"""``python -m benchmarks.recovery``: times until the death of an area is noticed, and until all areas are good again.

The 33-bus feeder runs in twelve areas, as processes. Again and again an area is killed, left dead for a while, and
started again. A watcher on the bus takes the times, from the signal to the arrival of a state that shows the change.
"""

from __future__ import annotations

import json
import os
import random
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import click

from agents.protocol.quality import GOOD
from agents.security.access import ROUTER, SECOND_ROUTER
from benchmarks.measuring.figures import figures_option, write_section
from benchmarks.measuring.live_system import GAP, LiveSystem, States
from benchmarks.measuring.machine import describe_machine
from coordinator.lab.strategy_check import check_with_strategy
from scenarios.scenario import Scenario, load_scenario

PACKAGES = ("eclipse-zenoh", "numpy")
AREAS = 12
DEAD_S = 0.5
DEADLINE_S = 20.0

HEARTBEAT_S = 0.2  # of the shipped scenarios
FEW_AREAS = 3  # few enough for a fast heartbeat
FAST_HEARTBEAT_S = 0.02  # so that a silence of some tens of milliseconds shows

Times = dict[str, list[float]]


def build_scenario(areas: int, routers: int, heartbeat_s: float) -> Scenario:
    """The feeder in ``areas`` areas, with one router or two linked ones."""
    changes = {"areas": {"count": areas}, "transport.routers": routers, "run.beat_s": heartbeat_s}
    return check_with_strategy(load_scenario("ieee33", changes=changes))


def kill_area(live: LiveSystem, victim: str) -> dict[str, float]:
    """Times, s: from the death of ``victim`` until all neighbours notice it, from its restart until all areas are
    good.
    """
    neighbours = [n.area for n in live.scenario.partition.area(victim).neighbours]
    incarnation = live.states[victim].header.incarnation
    mark = f"neighbour {victim} is gone"
    killed = time.monotonic()
    live.system.kill(victim)
    noticed = _wait(live, lambda states: all(mark in states[name].notes for name in neighbours))
    degraded = _wait(live, lambda states: all(states[name].quality != GOOD for name in neighbours))
    live.pass_time(DEAD_S)
    restarted = time.monotonic()
    live.system.restart(victim)
    whole = _wait(live, lambda states: states[victim].header.incarnation > incarnation and _is_whole(live, states))
    good = _wait(live, lambda states: all(states[name].quality == GOOD for name in live.areas))
    return {
        "area killed: all its neighbours say so": noticed - killed,
        "area killed: all its neighbours are no longer good": degraded - killed,
        "area restarted: all areas at the fixed point": whole - restarted,
        "area restarted: all areas good": good - restarted,
    }


def kill_router(live: LiveSystem) -> dict[str, float]:
    """Time from the restart of the only router until all areas are received again and are at the fixed point, s."""
    live.system.kill(ROUTER)
    live.pass_time(DEAD_S)
    restarted = time.monotonic()
    live.system.restart(ROUTER)
    whole = _wait(
        live, lambda states: all(live.received_at[name] > restarted for name in live.areas) and _is_whole(live, states)
    )
    return {"only router restarted: all areas received and at the fixed point": whole - restarted}


def lose_one_router(live: LiveSystem) -> dict[str, float]:
    """Longest silences of an area at a watcher, s: without any fault, and while the first of two routers is dead."""
    live.forget_silences()
    live.pass_time(DEAD_S)
    usual = live.longest_silence()
    live.forget_silences()
    live.system.kill(ROUTER)
    live.pass_time(DEAD_S)
    silence = live.longest_silence()
    live.system.restart(ROUTER)
    _wait(live, lambda states: _is_whole(live, states))
    live.system.kill(SECOND_ROUTER)  # so that all are linked to the first again
    live.pass_time(DEAD_S)
    live.system.restart(SECOND_ROUTER)
    _wait(live, lambda states: _is_whole(live, states))
    return {"longest silence of an area, no fault": usual, "longest silence, one of two routers killed": silence}


def _is_whole(live: LiveSystem, states: States) -> bool:
    """True where all areas are at the fixed point, and no area has a note."""
    return not any(states[name].notes for name in live.areas if name in states) and live.gap(states) <= GAP


def _wait(live: LiveSystem, holds: Callable[[States], bool]) -> float:
    """The time at which the states fulfil ``holds``."""
    at = live.wait_until(holds, DEADLINE_S)
    if at is None:
        raise SystemExit(f"error: did not happen within {DEADLINE_S:g} s; {live.describe()}")
    return at


def repeat(times: Times, found: dict[str, float]) -> None:
    """Add each time of ``found`` to its series."""
    for what, seconds in found.items():
        times.setdefault(what, []).append(seconds)


def summarise(times: Times) -> dict[str, dict[str, float]]:
    """Median and largest time of each series, ms."""
    return {
        what: {
            "times": len(series),
            "median_ms": round(1000 * statistics.median(series), 1),
            "worst_ms": round(1000 * max(series), 1),
        }
        for what, series in times.items()
    }


@click.command(context_settings={"show_default": True})
@click.option(
    "--kills", type=click.IntRange(1), default=30, help="Of areas, of the only router, and of one of two routers."
)
@click.option("--seed", type=click.IntRange(0), default=1)
@figures_option
def main(kills: int, seed: int, figures: str | None) -> None:
    """Print median and worst of each time as JSON."""
    times: Times = {}
    draws = random.Random(seed)
    with tempfile.TemporaryDirectory() as scratch:
        with LiveSystem(build_scenario(AREAS, 1, HEARTBEAT_S), Path(scratch) / "one") as live:
            _wait(live, lambda states: _is_whole(live, states))
            for _ in range(kills):
                repeat(times, kill_area(live, draws.choice(live.areas)))
            for _ in range(kills):
                repeat(times, kill_router(live))
        with LiveSystem(build_scenario(FEW_AREAS, 2, FAST_HEARTBEAT_S), Path(scratch) / "two") as linked:
            _wait(linked, lambda states: _is_whole(linked, states))
            for _ in range(kills):
                repeat(times, lose_one_router(linked))
    machine, summary = describe_machine(PACKAGES), summarise(times)
    heartbeats = {"beat_s": str(HEARTBEAT_S), "fast_beat_s": str(FAST_HEARTBEAT_S)}
    print(json.dumps(machine | heartbeats | summary, indent=2))
    if figures:
        write_section(figures, machine, make_table(summary))


def make_table(summary: Mapping[str, Mapping[str, float]]) -> str:
    """Markdown table of a ``summary`` that ``summarise`` has made."""
    rows = [f"| {what} | {' | '.join(f'{value:g}' for value in found.values())} |" for what, found in summary.items()]
    return "\n".join(["| what | times | median, ms | worst, ms |", "|---|---|---|---|", *rows])


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.recovery")
