"""``python -m benchmarks.broker_to_state``: from a value in an MQTT broker to states on the bus that rest on it.

A feeder whose clocks number scans runs as processes, with one gateway. Now and then all its meters publish at once, at
any moment between two ticks. A value is in the states of the first tick after it has arrived on the bus. The stages are
broker and gateway, until the last area's readings are on the bus; the wait for the tick; the exchange, until every area
shows a good state of that tick. States and readings that are lost on the way to this listener are counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before anything loads numpy

import aiomqtt
import click
import numpy as np
import tomli_w

from agents.messages.keys import all_readings, all_states, telemetry_key
from agents.messages.packing import ReadingsMessage, StateMessage, TelemetryMessage, decode
from agents.protocol.quality import GOOD
from agents.transport.zenoh_bus import Session
from benchmarks.measuring.figures import figures_option, list_facts, write_section
from benchmarks.measuring.machine import describe_machine
from coordinator.lab.deployment.split import write_area_files
from dsse_core.grid.measurement import Source
from dsse_core.power_flow.exact_readings import read_exactly
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.scenario import Scenario, load_scenario

PACKAGES = ("eclipse-zenoh", "numpy", "aiomqtt", "amqtt")
GATEWAY = "field"
START_S = 60.0
SETTLE_TICKS = 3  # after the last value


@dataclass
class Arrivals:
    """Messages received over the bus, with the UTC of their arrival; filled by the threads of the bus."""

    telemetry: list[tuple[float, str, float]] = field(default_factory=list)  # at, area, newest time of measurement
    taken: dict[tuple[str, int], float] = field(default_factory=dict)  # area and scan -> when its readings were taken
    good: dict[tuple[str, int], float] = field(default_factory=dict)  # area and scan -> its first good state
    readings: dict[str, list[int]] = field(default_factory=dict)  # area -> numbers of its messages of used readings

    def take(self, _key: str, payload: bytes) -> None:
        at, message = time.time(), decode(payload)
        match message:
            case TelemetryMessage():
                self.telemetry.append((at, message.area, max(message.times, default=0.0)))
            case ReadingsMessage():
                self.readings.setdefault(message.header.sender, []).append(message.header.sequence)
            case StateMessage():
                place = message.header.sender, message.header.scan
                if message.buses and message.quality == GOOD:
                    self.taken[place] = message.taken_at
                    self.good.setdefault(place, at)

    @property
    def lost_readings(self) -> tuple[int, int]:
        """(sent, lost): messages of used readings by their sequence numbers, and those that have not arrived."""
        sent = sum(max(numbers) - min(numbers) + 1 for numbers in self.readings.values())
        return sent, sent - sum(len(set(numbers)) for numbers in self.readings.values())


SCENARIO = """
version = 1
name = "live33"
description = "The 33-bus feeder in three areas, whose readings are live and whose clocks number scans"
network = "ieee33"
strategy = "information"
areas = {{ count = 3 }}

[measurements]
floor_kva = 1.0
zero_injection = "virtual"
voltage = {{ buses = [1, 16, 22, 30], sigma_percent = 0.2 }}
flow = {{ branches = "all", sigma_percent = 1.0 }}
injection = {{ buses = "all", sigma_percent = 10.0 }}

[telemetry]
source = "live"

[run]
scan_s = {scan_s}
"""


def write_files(folder: Path, scan_s: float, endpoint: str, port: int) -> tuple[Scenario, dict[str, float]]:
    """Scenario, area files and map in ``folder``; the scenario, and topic -> reading of its meter, p.u."""
    (folder / "scenario.toml").write_text(SCENARIO.format(scan_s=scan_s))
    scenario = load_scenario(folder / "scenario.toml")
    dict(write_area_files(scenario, scenario.name, [endpoint], folder / "areas"))
    exact, size = read_exactly(solve_power_flow(scenario.network), scenario.meters)
    meters = {
        meter.id: (value, max(0.01 * large, 1e-4))
        for meter, value, large in zip(scenario.meters, exact.tolist(), size.tolist(), strict=True)
        if meter.source is not Source.VIRTUAL
    }
    content = {
        "name": GATEWAY,
        "scenario": "scenario.toml",
        "source": {"kind": "mqtt", "host": "127.0.0.1", "port": port, "qos": 0},
        "reading": [
            {"address": meter, "meter": meter, "unit": "pu", "sigma": sigma} for meter, (_, sigma) in meters.items()
        ],
    }
    (folder / "map.toml").write_text(tomli_w.dumps(content))
    return scenario, {meter: value for meter, (value, _) in meters.items()}


@contextlib.contextmanager
def running(commands: Mapping[str, Sequence[object]], folder: Path) -> Iterator[None]:
    """Processes of ``dsse`` by name until the end of the block."""
    processes = []
    try:
        for name, command in commands.items():
            with (folder / f"{name}.log").open("wb") as log:
                words = [sys.executable, "-P", "-m", "coordinator", *map(str, command)]
                environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
                processes.append(subprocess.Popen(words, cwd=folder, env=environment, stdout=log, stderr=log))
        yield
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait()


@contextlib.asynccontextmanager
async def broker(port: int) -> AsyncIterator[aiomqtt.Client]:
    """A broker, and a client of it."""
    from amqtt.broker import Broker

    everybody = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
    made = Broker({"listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}"}}, "plugins": everybody})
    await made.start()
    try:
        async with aiomqtt.Client("127.0.0.1", port) as client:
            yield client
    finally:
        await made.shutdown()


async def publish(client: aiomqtt.Client, values: Mapping[str, float]) -> float:
    """Publish all values to the broker; the time stamp of the values, s since 1970."""
    now = time.time()
    for topic, value in values.items():
        await client.publish(topic, json.dumps({"value": value, "time": now}))
    return now


async def measure(folder: Path, values: int, scan_s: float, seed: int) -> tuple[list[float], Arrivals, Scenario]:
    """Publish ``values`` times; the times of publication, the messages that arrived, and the scenario."""
    port, mqtt_port = (random.Random(seed + os.getpid() + k).randint(10_000, 31_999) for k in range(2))
    endpoint, arrivals = f"tcp/127.0.0.1:{port}", Arrivals()
    scenario, meters = write_files(folder, scan_s, endpoint, mqtt_port)
    areas = [area.name for area in scenario.partition.areas]
    commands: dict[str, Sequence[object]] = {"router": ("router", "--listen", endpoint)}
    commands |= {area: ("agent", f"areas/{area}.toml") for area in areas}
    commands["gateway"] = ("gateway", "map.toml", "--connect", endpoint)
    draws, sent = random.Random(seed), []
    async with broker(mqtt_port) as client:
        with running(commands, folder), Session.connect([endpoint], START_S) as session:
            for area in areas:
                session.subscribe(telemetry_key(scenario.name, area, GATEWAY), arrivals.take)
            for expression in (all_states(scenario.name), all_readings(scenario.name)):
                session.subscribe(expression, arrivals.take)
            deadline = time.monotonic() + START_S
            while {area for area, _ in arrivals.good} != set(areas):
                if time.monotonic() > deadline:
                    raise click.ClickException(f"not all areas are good within {START_S:g} s")
                await publish(client, meters)
                await asyncio.sleep(scan_s / 2)
            for _ in range(values):
                sent.append(await publish(client, meters))
                await asyncio.sleep(draws.uniform(0.5, 1.5) * scan_s)
            await asyncio.sleep(SETTLE_TICKS * scan_s)
    return sent, arrivals, scenario


def find_stages(sent: Sequence[float], arrivals: Arrivals, scenario: Scenario) -> np.ndarray:
    """(n, 3): s in broker and gateway, waiting for the tick, and in the exchange, of each value that came through."""
    areas = [area.name for area in scenario.partition.areas]
    rows = []
    for moment in sent:
        there = [
            min((at for at, its, newest in arrivals.telemetry if its == area and newest >= moment), default=None)
            for area in areas
        ]
        if None in there:
            continue
        on_bus = max(at for at in there if at is not None)
        scans = sorted({scan for _, scan in arrivals.good})
        for scan in scans:
            places = [(area, scan) for area in areas]
            if all(place in arrivals.good and arrivals.taken[place] >= on_bus for place in places):
                tick = max(arrivals.taken[place] for place in places)
                rows.append((on_bus - moment, tick - on_bus, max(arrivals.good[place] for place in places) - tick))
                break
    return np.array(rows).reshape(-1, 3)


def summarise(stages: np.ndarray, sent: int, arrivals: Arrivals) -> dict[str, Any]:
    total, (shown, lost) = stages.sum(axis=1), arrivals.lost_readings
    names = ("broker and gateway", "wait for the tick", "exchange of the areas")
    facts: dict[str, Any] = {"values": sent, "values in states": len(stages)}
    facts["value in the broker to states of all areas, ms"] = _percentiles(total)
    without = stages[:, 0] + stages[:, 2]
    facts["the same without the wait for the tick, ms"] = _percentiles(without)
    for k, name in enumerate(names):
        share = {"share of the median, %": round(100 * float(np.median(stages[:, k]) / np.median(total)), 1)}
        facts[f"{name}, ms"] = _percentiles(stages[:, k]) | share
    facts["messages of used readings"] = shown
    facts["of these not received here"] = lost
    return facts


def _percentiles(seconds: np.ndarray) -> dict[str, float]:
    return {
        "median": round(1e3 * float(np.median(seconds)), 1),
        "99 %": round(1e3 * float(np.quantile(seconds, 0.99)), 1),
    }


@click.command(context_settings={"show_default": True})
@click.option("--values", type=click.IntRange(2), default=200, help="How often all meters publish.")
@click.option("--scan-s", type=click.FloatRange(min=0.05), default=1.0, help="Between two ticks.")
@click.option("--seed", type=click.IntRange(0), default=1)
@figures_option
def main(values: int, scan_s: float, seed: int, figures: str | None) -> None:
    """Exit code 1: fewer than 99 % of the values came into a state of all areas."""
    machine = describe_machine(PACKAGES)
    with tempfile.TemporaryDirectory() as folder:
        sent, arrivals, scenario = asyncio.run(measure(Path(folder), values, scan_s, seed))
    stages = find_stages(sent, arrivals, scenario)
    if not len(stages):
        raise click.ClickException("no value came into a good state of all areas")
    facts = {"scan, s": scan_s} | summarise(stages, len(sent), arrivals)
    print(json.dumps(machine | facts, indent=2))
    if figures:
        write_section(figures, machine, list_facts(facts))
    sys.exit(0 if len(stages) >= 0.99 * len(sent) else 1)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.broker_to_state")
