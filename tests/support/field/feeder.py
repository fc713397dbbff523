"""CIGRE's medium-voltage feeder in four areas, whose meters read in the field: three gateways, recorder, metrics.

Voltages read every second, flows every five, injections every sixty, all of it ``FASTER`` times as fast. Areas 1 and 2
have their meters behind an MQTT broker, area 3 behind an OPC UA server, area 4 behind a Modbus device.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import tomli_w

from coordinator.cli.main import run_command
from coordinator.lab.deployment.split import write_area_files
from dsse_core.grid.measurement import Source
from dsse_core.power_flow.exact_readings import read_exactly
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.scenario import Scenario, load_scenario
from tests.support.dsse_command import ENVIRONMENT, free_endpoint, free_port
from tests.support.field.field_meters import FieldMeter
from tests.support.pandapower_tables import LoadedLate
from tests.support.system_by_hand import SystemByHand

FASTER = 2
SCAN_S = 1.0 / FASTER
KINDS = {"vm": (1.0, 0.002), "flow": (5.0, 0.02), "injection": (60.0, 0.05)}  # from one reading to the next, s; p.u.
WAYS = {"area1": "mqtt", "area2": "mqtt", "area3": "opcua", "area4": "modbus"}
UNITS = {"v": "kV", "p": "kW", "q": "kvar"}  # by the first letter of a meter's id
FIELD = "tests.support.field.field"
TABLES = """
[measurements]
zero_injection = "virtual"
voltage = {{ buses = "all", sigma_pu = {vm[1]}, period_s = {vm[0]} }}
flow = {{ branches = "all", sigma_pu = {flow[1]}, period_s = {flow[0]} }}
injection = {{ buses = "all", sigma_pu = {injection[1]}, period_s = {injection[0]} }}

[telemetry]
source = "live"

[gateways]
mqtt = {{ areas = ["area1", "area2"] }}
opcua = {{ areas = ["area3"] }}
modbus = {{ areas = ["area4"] }}

[run]
scan_s = {scan_s}
"""


def import_cigre(folder: Path) -> Scenario:
    """The feeder's scenario, whose readings are live."""
    pandapower, networks = LoadedLate("pandapower"), LoadedLate("pandapower.networks")
    pandapower.to_json(networks.create_cigre_network_mv(), str(folder / "cigre.json"))
    command = ["import", str(folder / "cigre.json"), "--areas", "4", "--out", str(folder / "net")]
    assert run_command(command) == 0  # here, where pandapower is loaded already
    path = folder / "net" / "scenario.toml"
    head = path.read_text().partition("# The source has no measurements")[0]
    kinds = {kind: (period / FASTER, sigma) for kind, (period, sigma) in KINDS.items()}
    path.write_text(head + TABLES.format(scan_s=SCAN_S, **kinds))
    return load_scenario(path)


def make_meters(scenario: Scenario) -> list[FieldMeter]:
    """All meters of the field, which read the feeder's power flow."""
    network, found, registers = scenario.network, [], 0
    values, _ = read_exactly(solve_power_flow(network), scenario.meters)
    for meter, value in zip(scenario.meters, values.tolist(), strict=True):
        if meter.source is Source.VIRTUAL:
            continue
        way = WAYS[scenario.partition.area_of_meter(meter)]
        address = {"mqtt": meter.id, "opcua": f"ns=2;s={meter.id}", "modbus": f"holding:{2 * registers}:float32"}[way]
        registers += way == "modbus"
        name = meter.id.partition("@")[0]
        period_s, sigma = KINDS["vm" if name == "vm" else name.partition("_")[2]]
        size = network.bus(meter.bus).base_kv if name == "vm" else 1000.0 * network.base_mva
        found.append(FieldMeter(meter.id, way, address, value * size, sigma * size, period_s / FASTER))
    return found


class Field:
    """The process of the field, and the faults of its meters."""

    def __init__(self, meters: Sequence[FieldMeter], folder: Path) -> None:
        self.ports = {way: free_port() for way in ("mqtt", "opcua", "modbus")}
        orders = folder / "field.json"
        orders.write_text(json.dumps({"ports": self.ports, "meters": [asdict(meter) for meter in meters]}))
        with (folder / "field.log").open("w") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", FIELD, str(orders)],
                env=ENVIRONMENT,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        self._wait_for("ready")

    def set_faults(self, *, sign: Sequence[str] = (), frozen: Sequence[str] = ()) -> None:
        """From now on meters ``sign`` read the negative, and ``frozen`` ones nothing new; all others are right."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"sign": list(sign), "frozen": list(frozen)}) + "\n")
        self._process.stdin.flush()
        self._wait_for("done")

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _wait_for(self, word: str) -> None:
        assert self._process.stdout is not None
        line = self._process.stdout.readline().strip()
        assert line == word, f"the field said {line!r}; see field.log"


def write_maps(path: Path, meters: Sequence[FieldMeter], ports: dict[str, int]) -> None:
    """A map for each gateway, ``mqtt.toml`` and so on, beside the scenario file ``path``."""
    sources = {
        "mqtt": {"kind": "mqtt", "host": "127.0.0.1", "port": ports["mqtt"], "qos": 0},
        "opcua": {"kind": "opcua", "url": f"opc.tcp://127.0.0.1:{ports['opcua']}/", "interval_s": 0.05},
        "modbus": {"kind": "modbus", "host": "127.0.0.1", "port": ports["modbus"], "period_s": SCAN_S / 2},
    }
    for way, source in sources.items():
        readings = [
            {"address": meter.address, "meter": meter.id, "unit": UNITS[meter.id[0]], "sigma": meter.sigma}
            for meter in meters
            if meter.by == way
        ]
        content = {"name": way, "scenario": path.name, "source": source, "reading": readings}
        (path.parent / f"{way}.toml").write_text(tomli_w.dumps(content))


@contextmanager
def running_feeder(folder: Path) -> Iterator[FeederUnderWay]:
    """Everything that a deployment has, as processes; all of it ends with the block."""
    scenario, endpoint = import_cigre(folder), free_endpoint()
    path = folder / "net" / "scenario.toml"
    dict(write_area_files(scenario, scenario.name, [endpoint], folder / "areas"))
    meters = make_meters(scenario)
    field = Field(meters, folder)
    try:
        with SystemByHand(folder) as system:
            write_maps(path, meters, field.ports)
            yield FeederUnderWay(scenario, path, endpoint, meters, field, system)
    finally:
        field.close()


class FeederUnderWay:
    """``commands``: name of a process -> arguments of ``dsse``; ``port``: of the metrics."""

    def __init__(
        self,
        scenario: Scenario,
        path: Path,
        endpoint: str,
        meters: Sequence[FieldMeter],
        field: Field,
        system: SystemByHand,
    ) -> None:
        self.scenario, self.meters, self.field, self.system, self.endpoint = scenario, meters, field, system, endpoint
        self.port = free_port()
        to = ("--connect", endpoint)
        self.commands: dict[str, tuple[object, ...]] = {
            "router": ("router", "--listen", endpoint),
            "record": ("record", path, *to, "--run", scenario.name, "--out", "recording"),
            "metrics": ("metrics", *to, "--run", scenario.name, "--listen", f"127.0.0.1:{self.port}"),
            **{area: ("agent", f"areas/{area}.toml") for area in WAYS},
            **{way: ("gateway", path.parent / f"{way}.toml", *to) for way in dict.fromkeys(WAYS.values())},
        }

    def start(self, *names: str) -> None:
        """Start processes, all of them without names."""
        for name in names or self.commands:
            self.system.start(name, *self.commands[name])

    def meters_of(self, area: str, kind: str) -> list[FieldMeter]:
        """The meters of ``area`` whose id begins with ``kind``, the largest value first."""
        of_area = {m.id for m in self.scenario.meters if self.scenario.partition.area_of_meter(m) == area}
        found = [meter for meter in self.meters if meter.id in of_area and meter.id.startswith(kind)]
        return sorted(found, key=lambda meter: -abs(meter.value))
