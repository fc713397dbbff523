"""The processes of ieee33 with keys, started one by one, through a router or on direct links."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from agents.messages.keys import telemetry_key
from agents.runtime.presence import begin_incarnation
from agents.security.access import Access, access_of
from coordinator.lab.deployment.certificates import create_keys
from coordinator.lab.deployment.endpoints import choose_area_endpoints
from coordinator.lab.deployment.split import write_area_files
from coordinator.lab.plant.telemetry_messages import make_payloads
from scenarios.scenario import load_scenario
from tests.support.dsse_command import free_endpoint
from tests.support.system_by_hand import SystemByHand

RUN = "ieee33"
AREAS = ("area1", "area2", "area3")


class KeysByHand(SystemByHand):
    """The processes of ieee33 with keys, through a router or on direct links."""

    def __init__(self, folder: Path, scenario: Path) -> None:
        super().__init__(folder)
        self.scenario_file, self.scenario = scenario, load_scenario(scenario)
        self.direct = self.scenario.transport.kind == "neighbours"
        self.access: Access = access_of(self.scenario.partition, RUN)
        self.keys = folder / "keys"
        create_keys(self.keys, self.access, days=1, direct=self.direct)
        self.area_endpoints = choose_area_endpoints(self.scenario, "tls") if self.direct else {}
        self.endpoints = list(self.area_endpoints.values()) or [free_endpoint("tls")]
        self.files = dict(write_area_files(self.scenario, RUN, self.endpoints, folder / "areas", self.area_endpoints))

    def connect(self) -> list[str]:
        connect = [part for endpoint in self.endpoints for part in ("--connect", endpoint)]
        return [*connect, "--keys", str(self.keys), "--run", RUN]

    def start_router(self) -> None:
        self.start("router", "router", "--listen", self.endpoints[0], "--keys", self.keys)

    def start_others(self, areas: Sequence[str] = AREAS) -> None:
        self.start("plant", "plant", self.scenario_file, *self.connect())
        for area in areas:
            self.start(area, "agent", self.files[area], "--keys", self.keys)

    def lies(self) -> dict[str, bytes]:
        """Readings that nobody made, for every area."""
        payloads = make_payloads(replace(self.scenario, seed=99), RUN, begin_incarnation(), 10**9)
        return {telemetry_key(RUN, area): payload for area, payload in payloads.items()}


def scenario_of(edited_scenario: Callable[..., Path], kind: str) -> Path:
    path = edited_scenario(RUN)
    path.write_text(path.read_text() + f'[transport]\nkind = "{kind}"\n')
    return path
