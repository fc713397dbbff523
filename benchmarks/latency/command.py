"""``python -m benchmarks.latency``: from a scan's publication until all areas agree with its centralised estimate."""

from __future__ import annotations

import json
import os
import queue
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import click
import numpy as np

from agents.messages.keys import all_incarnations, all_states, telemetry_key
from agents.messages.packing import StateMessage, decode
from agents.runtime.presence import begin_incarnation
from agents.transport.zenoh_bus import Session
from benchmarks.latency.helics_round_trip import time_helics_round_trips
from benchmarks.latency.timed_agent import PING, PONG
from benchmarks.measuring.machine import describe_machine
from coordinator.lab.deployment.split import write_area_files
from coordinator.lab.evaluation.evaluation import choose_scenario, estimate_centralised
from coordinator.lab.plant.telemetry_messages import make_payloads
from coordinator.lab.process_run.processes import Launcher
from coordinator.lab.strategy_check import check_with_strategy
from dsse_core.errors import DsseError
from scenarios.scenario import Scenario
from scenarios.telemetry import make_telemetry

CLOSE = 1e-8  # p.u., complex
PINGS = 20  # before each scan
SMALL = bytes(200)
DEADLINE_S = 30.0
HEARTBEAT_S = 1.0
RUN = "latency"


@dataclass(frozen=True)
class Scan:
    """Payloads that are published, by area, and the voltages that the areas shall find: bus -> complex p.u."""

    payloads: dict[str, bytes]
    voltages: dict[int, complex]


@click.command(context_settings={"show_default": True})
@click.option("--scenario", "name", default="ieee33", help="Shipped name or file.")
@click.option("--scans", type=click.IntRange(1), default=40, help="Timed scans.")
def main(name: str, scans: int) -> None:
    """Time scans to consensus between processes on Zenoh, beside Zenoh's and HELICS's round trips; medians."""
    scenario = check_with_strategy(choose_scenario(name))
    incarnation = begin_incarnation()
    prepared = [
        _make_scan(scenario, make_payloads(scenario, RUN, incarnation, n, draw=n), n) for n in range(1, scans + 3)
    ]
    with tempfile.TemporaryDirectory() as folder, Launcher() as launcher:
        with _start(scenario, launcher, Path(folder)) as session:
            latencies, pings = _measure(scenario, session, prepared)
        launcher.close()
        timings = [json.loads(path.read_text()) for path in Path(folder).glob("*.timing")]
    for key, text in describe_machine(("numpy", "scipy", "eclipse-zenoh", "helics", "consensus-dsse")).items():
        click.echo(f"{key}: {text}")
    round_trip = statistics.median(pings)
    click.echo(f"\n{len(latencies)} scans, {len(scenario.network.buses)} buses, {len(timings)} areas; medians")
    click.echo(f"Zenoh round trip, {len(SMALL)} bytes: {1e3 * round_trip:.3f} ms")
    latency = statistics.median(latencies)
    click.echo(f"scan to consensus within {CLOSE:g}: {1e3 * latency:.2f} ms, {latency / round_trip:.1f} round trips")
    for part in ("decode", "solve", "encode"):
        total, calls = (sum(timing[key].get(part, 0) for timing in timings) for key in ("seconds", "calls"))
        scale = len(prepared) * len(timings)
        click.echo(f"  {part}: {1e3 * total / scale:.2f} ms in {calls / scale:.1f} calls per area and scan")
    helics = time_helics_round_trips(len(SMALL), 10 * PINGS)
    text = helics if isinstance(helics, str) else f"{1e3 * statistics.median(helics):.3f} ms"
    click.echo(f"HELICS round trip, {len(SMALL)} bytes: {text}")


def _make_scan(scenario: Scenario, payloads: dict[str, bytes], draw: int) -> Scan:
    report = estimate_centralised(scenario, make_telemetry(scenario, draw)).report
    if report is None:
        raise click.ClickException(f"the centralised estimate of draw {draw} fails")
    v = report.result.vm * np.exp(1j * report.result.va)
    return Scan(payloads, {bus.id: complex(v[row]) for row, bus in enumerate(scenario.network.buses)})


@contextmanager
def _start(scenario: Scenario, launcher: Launcher, folder: Path) -> Iterator[Session]:
    """Router, echo and agents as processes, and a session of ours, once all areas are present."""
    launcher.preload("coordinator.lab.process_run.router_process", "benchmarks.latency.timed_agent")
    endpoints_file = folder / "router.endpoints"
    arguments = ["--listen", "tcp/127.0.0.1:0", "--endpoints-file", str(endpoints_file)]
    launcher.start(
        "router",
        "coordinator.lab.process_run.router_process:main",
        arguments,
        log=folder / "router.log",
        stop_last=True,
    )
    _wait(endpoints_file.exists)
    endpoint = endpoints_file.read_text().split()[0]
    launcher.start("echo", "benchmarks.latency.timed_agent:run_echo", endpoint, log=folder / "echo.log")
    present: set[str] = set()
    with Session.connect([endpoint]) as session:
        session.watch_presence(
            all_incarnations(RUN, "area", "*"), lambda key, alive: present.add(key) if alive else None
        )
        for area, path in write_area_files(scenario, RUN, [endpoint], folder / "areas", suffix=".json"):
            order = (str(path), str(folder / f"{area}.timing"))
            launcher.start(area, "benchmarks.latency.timed_agent:run_timed_agent", *order, log=folder / f"{area}.log")
        _wait(lambda: len(present) == len(scenario.partition.areas))
        yield session


def _measure(scenario: Scenario, session: Session, scans: list[Scan]) -> tuple[list[float], list[float]]:
    """Latency of every scan but the first two, and times of the round trips between them, s."""
    publish = {area.name: session.publisher(telemetry_key(RUN, area.name)) for area in scenario.partition.areas}
    received: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
    session.subscribe(all_states(RUN), lambda _key, payload: received.put((time.perf_counter(), payload)))
    pong: queue.SimpleQueue[float] = queue.SimpleQueue()
    session.subscribe(PONG, lambda _key, _payload: pong.put(time.perf_counter()))
    ping = session.publisher(PING)
    _wait(lambda: (ping(SMALL), not pong.empty())[1])
    latencies, pings = [], []
    for number, scan in enumerate(scans, start=1):

        def publish_scan(scan: Scan = scan) -> None:
            for area, payload in scan.payloads.items():
                publish[area](payload)

        start = time.perf_counter()
        publish_scan()
        latency = _wait_for_consensus(scan, number, publish_scan, received) - start
        time.sleep(0.05)  # until the areas are idle
        while not pong.empty():
            pong.get()
        times = []
        for _ in range(PINGS):
            start = time.perf_counter()
            ping(SMALL)
            with suppress(queue.Empty):  # dropped by the bus under load
                times.append(pong.get(timeout=HEARTBEAT_S) - start)
        if number > 2:  # before, nothing is warm
            latencies.append(latency)
            pings += times
    return latencies, pings


def _wait_for_consensus(
    scan: Scan, number: int, publish_scan: Callable[[], None], received: queue.SimpleQueue[tuple[float, bytes]]
) -> float:
    """Time at which the last area has shown a state of scan ``number`` that is close to the centralised one.

    Readings that the bus drops under load are published again at every heartbeat, as the plant does it.
    """
    areas = set(scan.payloads)
    deadline, next_heartbeat = time.perf_counter() + DEADLINE_S, time.perf_counter() + HEARTBEAT_S
    close: set[str] = set()
    while True:
        now = time.perf_counter()
        if now > deadline:
            missing = ", ".join(sorted(areas - close))
            raise click.ClickException(f"{missing}: not within {CLOSE:g} of scan {number} in {DEADLINE_S:g} s")
        if now >= next_heartbeat:
            next_heartbeat = now + HEARTBEAT_S
            publish_scan()
        try:
            at, payload = received.get(timeout=next_heartbeat - now)
        except queue.Empty:
            continue
        state = decode(payload)
        assert isinstance(state, StateMessage)
        if state.header.scan == number and state.buses and _gap(state, scan) <= CLOSE:
            close.add(state.header.sender)
        else:
            close.discard(state.header.sender)
        if close == areas:
            return at


def _gap(state: StateMessage, scan: Scan) -> float:
    v = np.array(state.vm) * np.exp(1j * np.array(state.va))
    return float(abs(v - np.array([scan.voltages[bus] for bus in state.buses])).max())


def _wait(done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not done():
        if time.monotonic() > deadline:
            raise DsseError(f"the processes are not there after {DEADLINE_S:g} s")
        time.sleep(0.01)
