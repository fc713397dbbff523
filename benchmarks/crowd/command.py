"""The feeder, its watchers and the strangers: figures before, while and after the strangers are announced."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import click
import psutil

from agents.protocol.quality import GOOD
from agents.security.access import access_of
from benchmarks.measuring.figures import conclude, figures_option
from benchmarks.measuring.live_system import GAP, LiveSystem
from benchmarks.measuring.machine import describe_machine
from coordinator.lab.deployment.certificates import create_keys
from coordinator.lab.strategy_check import check_with_strategy
from scenarios.scenario import load_scenario

PACKAGES = ("eclipse-zenoh", "starlette", "uvicorn")
SCENARIO = "ieee33"
SCAN_S = 1.0
LOOK_S = 0.5
SILENT_S = 2.0  # without a state for so long an area is not good for a watcher
LEAST_GOOD = 0.95  # share of looks in each phase
PHASE_S = 10.0  # before the strangers come, with all of them there, and without them
ANNOUNCED_S = 600.0  # by then all must be announced
MOST_MEMORY_MIB = 400.0  # of a watcher
OPEN, KNOWING, WITH_KEYS = "open", "knowing", "keys"
ROUTERS = {
    OPEN: "what anybody says, as a plain `dsse router` does",
    KNOWING: "what processes of the run say, as that of `dsse run` does",
    WITH_KEYS: "what processes of the run say that show a key",
}
LISTENS, RECORDS = ["--listen", "127.0.0.1:0"], ["--out", "recording"]
ONLOOKERS = {
    "serve": ["serve", *LISTENS],
    "serve with the scenario": ["serve", SCENARIO, *LISTENS],
    "watch": ["watch"],
    "watch with the scenario": ["watch", SCENARIO, "--buses", "--meters"],
    "watch --json": ["watch", "--json"],
    "metrics": ["metrics", *LISTENS],
    "record": ["record", *RECORDS],
}


@dataclass
class Phases:
    """Figures of each phase: of all ``processes`` (name -> id) and of the areas."""

    live: LiveSystem
    processes: Mapping[str, int]
    took_s: dict[str, float] = field(default_factory=dict)
    scans: dict[str, int] = field(default_factory=dict)
    silence_s: dict[str, float] = field(default_factory=dict)
    gap: dict[str, float] = field(default_factory=dict)
    good: dict[str, float] = field(default_factory=dict)  # share of looks at which a newly received area was good
    memory_mib: dict[str, dict[str, float]] = field(default_factory=dict)
    cores: dict[str, dict[str, float]] = field(default_factory=dict)

    def watch(self, phase: str, duration_s: float, is_over: Callable[[], bool] = lambda: False) -> None:
        """Watch for ``duration_s``, or until ``is_over``."""
        began, first = time.monotonic(), self._scan()
        self.live.forget_silences()
        spent = {name: _spent_s(pid) for name, pid in self.processes.items()}
        gaps, good = [0.0], list[bool]()
        memory = self.memory_mib[phase] = dict.fromkeys(self.processes, 0.0)
        while time.monotonic() < began + duration_s and not is_over():
            self.live.pass_time(LOOK_S)
            seen = [self._is_good(area) for area in self.live.areas]
            gap = self.live.gap(self.live.states) if all(seen) else float("inf")
            gaps += [gap] if gap < float("inf") else []  # areas show different scans just after a scan has begun
            good += seen
            for name, pid in self.processes.items():
                memory[name] = max(memory[name], round(psutil.Process(pid).memory_info().rss / 2**20, 1))
        now = time.monotonic()
        took_s = now - began
        self.took_s[phase], self.scans[phase] = round(took_s, 1), self._scan() - first
        self.gap[phase], self.good[phase] = max(gaps), round(sum(good) / max(1, len(good)), 3)
        silences = [now - at for at in self.live.received_at.values()]
        self.silence_s[phase] = round(max(self.live.longest_silence(), *silences), 1)
        self.cores[phase] = {
            name: round((_spent_s(pid) - spent[name]) / took_s, 2) for name, pid in self.processes.items()
        }

    def _is_good(self, area: str) -> bool:
        """True where the area marks its state as good, and its last state arrived within ``SILENT_S``."""
        age_s = time.monotonic() - self.live.received_at[area]
        return self.live.states[area].quality == GOOD and age_s < SILENT_S

    def _scan(self) -> int:
        return max(state.header.scan for state in self.live.states.values())


def _spent_s(pid: int) -> float:
    times = psutil.Process(pid).cpu_times()
    return float(times.user + times.system)


@contextmanager
def onlookers(
    endpoint: str, folder: Path, chosen: Sequence[str], keys: Path | None
) -> Iterator[dict[str, subprocess.Popen[bytes]]]:
    """The commands named in ``chosen``, running in ``folder``, which gets their logs; ``keys``: their credentials."""
    shown = ["--keys", str(keys)] if keys else []
    with ExitStack() as stack:
        started = {}
        for name in chosen:
            log = stack.enter_context((folder / f"{name}.log").open("wb"))
            words = ["-m", "coordinator", *ONLOOKERS[name], "--connect", endpoint, "--run", "live", *shown]
            nothing: Any = subprocess.DEVNULL
            process = subprocess.Popen([sys.executable, *words], cwd=folder, stdin=nothing, stdout=nothing, stderr=log)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            started[name] = process
        yield started


@contextmanager
def crowd(endpoint: str, count: int, large: int, router: str) -> Iterator[Callable[[], bool]]:
    """The strangers, in a process until the end of the block; a function that is true once after all are announced."""
    words = [sys.executable, "-m", "benchmarks.crowd.stranger", endpoint, "live", str(count), str(large), router]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        output = process.stdout
        os.set_blocking(output.fileno(), False)
        try:
            yield lambda: bool(output.read())
        finally:
            process.kill()


def measure(folder: Path, count: int, large: int, chosen: Sequence[str], router: str) -> dict[str, Any]:
    """Cost of ``count`` strangers, ``large`` of them with states of 90,000 buses, for the areas and ``chosen``.

    ``router``: of ``ROUTERS``.
    """
    scenario = check_with_strategy(load_scenario(SCENARIO))
    keys = folder / "keys" if router == WITH_KEYS else None
    if keys:
        create_keys(keys, access_of(scenario.partition, "live", scenario.reading_rules), 1.0, ["127.0.0.1"])
    with LiveSystem(scenario, folder / "run", SCAN_S, any_name=router == OPEN, keys=keys) as live:
        live.wait_until(lambda states: len(states) == len(live.areas))
        endpoint = live.system.endpoints[0]
        with onlookers(endpoint, folder, chosen, keys) as started:
            live.pass_time(PHASE_S)
            phases = Phases(live, live.system.pids | {name: process.pid for name, process in started.items()})
            phases.watch("before", PHASE_S)
            with crowd(endpoint, count, large, router) as are_announced:
                phases.watch("announcing", ANNOUNCED_S, are_announced)
                phases.watch("there", PHASE_S)
            phases.watch("after", 2 * PHASE_S)
            ended = [name for name, process in started.items() if process.poll() is not None]
        return {
            "strangers": count,
            "the router passes on": ROUTERS[router],
            "s": phases.took_s,
            "scans": phases.scans,
            "longest time without a state of an area, s": phases.silence_s,
            "largest gap of good areas to the centralised estimate": phases.gap,
            "share of looks at which an area was good": phases.good,
            "most memory, MiB": {
                name: max(phases.memory_mib[phase][name] for phase in phases.took_s) for name in phases.processes
            },
            "cores while announcing": phases.cores["announcing"],
            "cores while there": phases.cores["there"],
            "ended unasked": [*ended, *live.strays],
        }


def find_failures(seen: Mapping[str, Any]) -> list[str]:
    """Requirements that the figures ``seen`` do not meet."""
    most = {name: seen["most memory, MiB"][name] for name in ONLOOKERS if name in seen["most memory, MiB"]}
    large = [name for name, mebibytes in most.items() if mebibytes > MOST_MEMORY_MIB]
    gap = max(seen["largest gap of good areas to the centralised estimate"].values())
    good = min(seen["share of looks at which an area was good"].values())
    checks = {
        f"a good estimate is off by more than {GAP:g}": gap <= GAP,
        f"areas were good at less than {LEAST_GOOD:.0%} of the looks": good >= LEAST_GOOD,
        f"more than {MOST_MEMORY_MIB:g} MiB: {', '.join(large)}": not large,
        "a process ended unasked": not seen["ended unasked"],
    }
    return [failure for failure, holds in checks.items() if not holds]


@click.command(context_settings={"show_default": True})
@click.option("--areas", type=click.IntRange(1), default=2000, help="Strangers that call themselves areas.")
@click.option("--large", type=click.IntRange(0), default=0, help="Those of them with states of 90,000 buses.")
@click.option("--router", type=click.Choice(list(ROUTERS)), default=KNOWING, help="With keys, or which it knows.")
@click.option("--only", type=click.Choice(list(ONLOOKERS)), multiple=True, help="Who looks on; repeatable.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), help="Folder for logs.  [default: temporary]")
@figures_option
def main(areas: int, large: int, router: str, only: tuple[str, ...], out: Path | None, figures: str | None) -> None:
    """Exit code 0: no estimate is disturbed, and nobody who looks on ends or takes too much memory; 1: not."""
    if out:
        out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        machine = describe_machine(PACKAGES)
        seen = measure((out or Path(scratch)).absolute(), areas, large, only or tuple(ONLOOKERS), router)
    conclude(machine, seen, find_failures(seen), figures)
