"""``python -m benchmarks.soak``: a feeder in twelve areas under faults for minutes, and its recovery after them.

A new scan begins every second. Now and then, drawn from the seed, an area, the plant or the router is killed and
started again, or frozen for a while; neighbours are cut off from each other; on each link messages are lost (up to
every second), doubled, held back and damaged. Then the faults stop.
"""

from __future__ import annotations

import os
import random
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import click
import psutil

from agents.protocol.quality import GOOD
from agents.security.access import PLANT, ROUTER
from benchmarks.measuring.figures import conclude, figures_option
from benchmarks.measuring.live_system import GAP, LiveSystem
from benchmarks.measuring.machine import describe_machine
from coordinator.lab.strategy_check import check_with_strategy
from scenarios.scenario import Scenario, load_scenario

PACKAGES = ("eclipse-zenoh", "numpy")
AREAS = 12
SCAN_S = 1.0
MOST_LOSS = 0.5
OF_ALL_LINKS = {"jitter_ms": 20.0, "duplicate": 0.05, "corrupt": 0.02}
CUT_EVERY_S = 10.0
CUT_FOR_S = (0.5, 5.0)
BETWEEN_S = (0.5, 2.5)  # from one fault to the next
DOWN_S = (0.2, 4.0)  # length of a fault
MOST_DOWN = 3  # processes at a time
SPARED = 2  # areas that are never killed or frozen, so that one incarnation shows the course of memory
WARM_S = 20.0  # until memory counts
MOST_GROWTH_MIB = 3.0
RECOVERY_S = 60.0
TROUBLE = ("Traceback", "Exception", "Error", "panicked")


@dataclass
class Soak:
    """State of a soak: processes that are down and until when, faults so far, and memory over time."""

    live: LiveSystem
    draws: random.Random
    down: dict[str, tuple[str, float]] = field(default_factory=dict)  # name -> (what was done, until when)
    counts: Counter[str] = field(default_factory=Counter)
    rss_mib: dict[tuple[str, int], list[float]] = field(
        default_factory=dict
    )  # of one incarnation of a process, once a second
    scans: set[int] = field(default_factory=set)  # scans of which all areas have shown the centralised estimate

    def go_on(self, duration_s: float) -> None:
        """Let faults happen for ``duration_s``."""
        began = now = time.monotonic()
        next_fault = next_look = began
        while now < began + duration_s:
            self.live.take(0.05)
            now = time.monotonic()
            self._lift(now)
            if now >= next_fault:
                next_fault = now + self.draws.uniform(*BETWEEN_S)
                self._strike(now)
            if now >= next_look:
                next_look = now + 1.0
                self._look(now - began)
        self._lift(float("inf"))

    def _strike(self, now: float) -> None:
        victims = [*self.live.areas[SPARED:], PLANT, ROUTER]
        what, name = self.draws.choice(("kill", "kill", "pause")), self.draws.choice(victims)
        if len(self.down) >= MOST_DOWN or name in self.down:
            return
        system = self.live.system
        (system.kill if what == "kill" else system.pause)(name)
        self.down[name] = (what, now + self.draws.uniform(*DOWN_S))
        self.counts[f"{name if name in (PLANT, ROUTER) else 'area'} {what}"] += 1

    def _lift(self, now: float) -> None:
        for name, (what, until) in list(self.down.items()):
            if now >= until:
                system = self.live.system
                (system.restart if what == "kill" else system.go_on)(name)
                del self.down[name]

    def _look(self, elapsed_s: float) -> None:
        if self.live.gap(self.live.states) <= GAP:
            self.scans.add(max(state.header.scan for state in self.live.states.values()))
        if elapsed_s < WARM_S:
            return
        for incarnation in self.live.system.pids.items():
            with suppress(psutil.NoSuchProcess):
                self.rss_mib.setdefault(incarnation, []).append(
                    psutil.Process(incarnation[1]).memory_info().rss / 2**20
                )


def build_scenario(seed: int, duration_s: float) -> Scenario:
    """The 33-bus feeder in twelve areas; ``duration_s``: how long its links have faults."""
    draws = random.Random(seed)
    plain: dict[str, object] = {"areas": {"count": AREAS}, "run.timeout_s": 2 * duration_s}
    links = list(load_scenario("ieee33", changes=plain).faults.links)
    cuts = [
        {
            "at_s": CUT_EVERY_S * k + draws.uniform(0, CUT_EVERY_S - max(CUT_FOR_S)),  # none falls into another
            "cut": list(draws.choice(links)),
            "for_s": draws.uniform(*CUT_FOR_S),
        }
        for k in range(round(duration_s / CUT_EVERY_S))
    ]
    losses = [{"from": one, "to": other, "loss": draws.uniform(0, MOST_LOSS)} for one, other in links]
    faults = {"until_s": duration_s, "events": cuts, "link": losses, **OF_ALL_LINKS}
    return check_with_strategy(load_scenario("ieee33", changes=plain | {"seed": seed, "faults": faults}))


def soak(folder: Path, seed: int, duration_s: float) -> dict[str, object]:
    """Run with faults for ``duration_s``, then without; figures of the run, as text and numbers."""
    scenario = build_scenario(seed, duration_s)
    with LiveSystem(scenario, folder, SCAN_S) as live:
        live.wait_until(lambda states: len(states) == AREAS)
        live.begin()
        under_way = Soak(live, random.Random(seed))
        under_way.go_on(duration_s)
        live.system.hold_scan()  # else a slow machine might never end a scan before the next
        stopped = time.monotonic()
        recovered = live.wait_until(lambda states: live.gap(states) <= GAP, RECOVERY_S)
        good = live.wait_until(lambda states: all(state.quality == GOOD for state in states.values()), RECOVERY_S)
        alive = [name for name, pid in live.system.pids.items() if psutil.pid_exists(pid)]
        memory = {incarnation: values for incarnation, values in under_way.rss_mib.items() if len(values) > 1}
        last = live.states.values()
        return {
            "seed": seed,
            "duration_s": duration_s,
            "faults of processes": dict(sorted(under_way.counts.items())),
            "cuts": len(scenario.faults.events),
            "faults of links, of the last incarnations": dict(
                sum((Counter(state.faults) for state in last), Counter())
            ),
            "rejected, by the last incarnations": dict(sum((Counter(state.rejected) for state in last), Counter())),
            "scans that all areas had solved at once": len(under_way.scans),
            "scan at the end": max(state.header.scan for state in last),
            "gap at the end": live.gap(live.states),
            "s from the last fault to it": None if recovered is None else round(recovered - stopped, 2),
            "s until all areas are good": None if good is None else round(good - stopped, 2),
            "processes alive of": [len(alive), AREAS + 2],
            "ended unasked": live.strays,
            "growth of the longest incarnations in their second half, MiB": {
                name: round(values[-1] - values[len(values) // 2], 2)
                for (name, _), values in memory.items()
                if len(values) == max(map(len, memory.values()))
            },
            "largest process, MiB": round(max((max(values) for values in memory.values()), default=0.0), 1),
            "what areas lack at the end": live.describe(),
            "trouble in logs": list(find_trouble(folder)),
        }


def find_trouble(folder: Path) -> Iterator[str]:
    """Lines of the logs that look like an exception that was not handled."""
    for log in sorted((folder / "logs").glob("*.log")):
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
            if any(word in line for word in TROUBLE):
                yield f"{log.name}: {line}"


def find_failures(seen: Mapping[str, Any]) -> list[str]:
    """Requirements that the figures ``seen`` do not meet."""
    growth = seen["growth of the longest incarnations in their second half, MiB"].values()
    checks = {
        f"the gap at the end exceeds {GAP:g}": seen["s from the last fault to it"] is not None,
        "an area is not good at the end": seen["s until all areas are good"] is not None,
        "a process is lost": seen["processes alive of"] == [AREAS + 2] * 2 and not seen["ended unasked"],
        "a log tells of an exception": not seen["trouble in logs"],
        f"a process grew by more than {MOST_GROWTH_MIB:g} MiB": max(growth, default=0.0) <= MOST_GROWTH_MIB,
    }
    return [failure for failure, good in checks.items() if not good]


@click.command(context_settings={"show_default": True})
@click.option("--minutes", type=click.FloatRange(min=0.1), default=10.0)
@click.option("--seed", type=click.IntRange(0), default=1)
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), help="Folder for logs.  [default: temporary]")
@figures_option
def main(minutes: float, seed: int, out: Path | None, figures: str | None) -> None:
    """Exit code 0: whole again after the faults; 1: not, and standard error says what is wrong."""
    with tempfile.TemporaryDirectory() as scratch:
        machine, seen = describe_machine(PACKAGES), soak(out or Path(scratch) / "soak", seed, 60.0 * minutes)
    conclude(machine, seen, find_failures(seen), figures, left_out={"trouble in logs"})


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.soak")
