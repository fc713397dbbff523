"""A live industrial13 whose areas run as processes; its meters are read by what a test starts."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from agents.messages.checks import MessageError
from agents.messages.keys import all_states
from agents.messages.packing import StateMessage, decode
from agents.security.access import WATCHER
from agents.security.credentials import load_keys
from agents.transport.zenoh_bus import Session
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import read_meters
from tests.support.dsse_command import free_endpoint
from tests.support.system_by_hand import SystemByHand
from tests.support.waiting import DEADLINE_S, wait_until

AREAS = ("area1", "area2")
LIVE = ("noise = true", "[run]\nscan_s = 0.25")
SECURED = ("noise = true", '[gateways.north]\nareas = "all"\n[gateways.south]\nareas = ["area1"]\n[run]\nscan_s = 0.25')
READING = '[[reading]]\naddress = "{}"\nmeter = "{}"\nunit = "{}"\nsigma = {!r}\n'


@dataclass
class LiveSystem:
    """``values``: meter id -> what it reads, p.u. ``keys``: the options that name the credentials, if there are any.
    ``states``: area -> its newest state.
    """

    folder: Path
    endpoint: str
    scenario: Scenario
    processes: SystemByHand
    values: dict[str, float]
    sigmas: dict[str, float]
    keys: Sequence[str]
    states: dict[str, StateMessage] = field(default_factory=dict)

    def write_map(self, name: str, source: str, address: Callable[[str], str], *more: str) -> Path:
        """A map of all meters in p.u.; ``address``: of a meter."""
        path = self.folder / f"{name}.toml"
        head = f'name = "{name}"\nscenario = "edited.toml"\nrun = "live"\nconnect = ["{self.endpoint}"]\n'
        readings = [READING.format(address(meter), meter, "pu", self.sigmas[meter]) for meter in self.values]
        path.write_text("\n".join([head, source, *readings, *more]))
        return path

    def wait_for(self, quality: str) -> None:
        """Until all areas say this of their states."""
        wait_until(lambda: [state.quality for state in tuple(self.states.values())] == [quality] * len(AREAS))


@pytest.fixture
def live(request: pytest.FixtureRequest, dsse, edited_scenario, tmp_path: Path) -> Iterator[LiveSystem]:
    """Router and areas, without any reading; with parameter "keys" all of them have keys, and north the meters."""
    is_secured = getattr(request, "param", "") == "keys"
    path = edited_scenario("industrial13", SECURED if is_secured else LIVE, ('source = "network" ', 'source = "live" '))
    known, endpoint = load_scenario("industrial13"), free_endpoint("tls" if is_secured else "tcp")
    keys = ["--keys", "keys"] if is_secured else []
    if is_secured:
        assert dsse("keys", "create", path, "--out", "keys", "--run", "live").returncode == 0
    scan = read_meters(known)
    found = [(m.id, v, s) for m, v, s in zip(known.meters, scan.values, scan.sigmas, strict=True) if s > 0]
    assert dsse("split", path, "--out", "areas", "--run", "live", "--connect", endpoint).returncode == 0
    with SystemByHand(tmp_path) as processes:
        processes.start("router", "router", "--listen", endpoint, *keys)
        for name in AREAS:
            processes.start(name, "agent", f"areas/{name}.toml", *keys)
        values = {meter: float(value) for meter, value, _ in found}
        sigmas = {meter: float(sigma) for meter, _, sigma in found}
        system = LiveSystem(tmp_path, endpoint, load_scenario(path), processes, values, sigmas, keys)

        def take(_: str, payload: bytes) -> None:
            try:
                message = decode(payload)
            except MessageError:
                return
            if isinstance(message, StateMessage):
                system.states[message.header.sender] = message

        watching = load_keys(tmp_path / "keys", WATCHER) if is_secured else None
        with Session.connect([endpoint], DEADLINE_S, watching) as session:
            session.subscribe(all_states("live"), take)
            yield system


def read_status(path: Path) -> dict[str, object]:
    """A status file; empty while there is none."""
    return json.loads(path.read_text()) if path.exists() else {}


@pytest.fixture
def status_of(tmp_path: Path) -> Callable[[str], dict[str, object]]:
    """What the status file NAME says."""
    return lambda name: read_status(tmp_path / name)
