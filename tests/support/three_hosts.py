"""Three hosts a - b - c in a line, a router and an area on each; the link a - b is taken down and up again.

Runs in a network namespace of its own, which is host b (``unshare``); the other two are its children. The processes
are those of the units in ``deploy/``, with certificates. Prints what happened as JSON.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from agents.messages.packing import StateMessage
from agents.security.access import access_of
from coordinator.lab.deployment.certificates import create_keys
from coordinator.lab.deployment.split import write_area_files
from coordinator.lab.evaluation.comparison import Gap
from scenarios.scenario import load_scenario
from tests.support.system_by_hand import SystemByHand, Watcher
from tests.support.units import DEPLOY, command_of, read_host_file

RUN = "ieee33"
LOCAL = "tls/127.0.0.1:7448"
AREA_ON = {"a": "area1", "b": "area2", "c": "area3"}  # area1 is the neighbour of both others
PLANT_ON = "b"
NETWORK_TO = {"a": "10.77.1", "c": "10.77.2"}  # of the link between b and that host; b is number 1


def run(*command: object) -> None:
    subprocess.run([str(part) for part in command], check=True)


@contextmanager
def linked_hosts() -> Iterator[Mapping[str, list[str]]]:
    """Host -> the command that runs something there."""
    run("ip", "link", "set", "lo", "up")
    homes = {name: subprocess.Popen(["unshare", "--net", "sleep", "infinity"]) for name in NETWORK_TO}
    try:
        there = {name: ["nsenter", "--net", f"--target={home.pid}"] for name, home in homes.items()}
        for name, network in NETWORK_TO.items():
            _wait_for_namespace(there[name])
            run("ip", "link", "add", f"to_{name}", "type", "veth", "peer", "name", "to_b", "netns", homes[name].pid)
            run("ip", "address", "add", f"{network}.1/24", "dev", f"to_{name}")
            run("ip", "link", "set", f"to_{name}", "up")
            run(*there[name], "ip", "address", "add", f"{network}.2/24", "dev", "to_b")
            for device in ("to_b", "lo"):
                run(*there[name], "ip", "link", "set", device, "up")
        yield {"b": [], **there}
    finally:
        for home in homes.values():
            home.kill()
            home.wait()


def _wait_for_namespace(enter: list[str]) -> None:
    """Until the child has left our namespace: it does not see the loopback that is up here."""
    for _ in range(1000):
        links = subprocess.run([*enter, "ip", "link", "show", "lo", "up"], capture_output=True, text=True, check=False)
        if links.returncode == 0 and not links.stdout:
            return
    raise AssertionError("no namespace of its own for a host")


def host_variables(host: str) -> dict[str, str]:
    """The host file of ``deploy/`` for one of our hosts; b is called by the others."""
    text = (DEPLOY / "host.env").read_text()
    call = " --connect tls/host-b.example:7447"
    assert call in text
    here = text.replace(call, f" --connect tls/{NETWORK_TO[host]}.1:7447" if host in NETWORK_TO else "")
    return read_host_file(here.replace(" --every 60", ""))  # one scan, which is compared with the centralised estimate


def start_all(system: SystemByHand, there: Mapping[str, list[str]]) -> None:
    scenario = load_scenario(RUN)
    dict(write_area_files(scenario, RUN, [LOCAL], system.folder / "areas"))
    hosts = [f"{network}.{number}" for network in NETWORK_TO.values() for number in (1, 2)]
    create_keys(system.folder / "keys", access_of(scenario.partition, RUN), days=1, hosts=hosts, apart=True)
    for host, area in AREA_ON.items():
        variables = host_variables(host)
        units = {f"router-{host}": "dsse-router.service", area: "dsse-agent@.service"}
        if host == PLANT_ON:
            units["plant"] = "dsse-plant.service"
        for name, unit in units.items():
            system.start(name, *command_of(unit, variables, system.folder, area), prefix=there[host])


def combine(gap: Gap) -> float:
    """The larger of both, p.u. and rad."""
    assert gap.vm_pu is not None
    assert gap.va_deg is not None
    return max(gap.vm_pu, math.radians(gap.va_deg))


def main(folder: Path) -> None:
    with linked_hosts() as there, SystemByHand(folder) as system:
        start_all(system, there)
        with Watcher(RUN, [LOCAL], folder / "keys") as watcher:
            reported: dict[str, object] = {"gap before": combine(watcher.wait_for_consensus())}
            run("ip", "link", "set", "to_a", "down")
            cut_off = "neighbour area1 is gone"
            others: tuple[StateMessage, ...] = ()

            def noticed() -> bool:
                nonlocal others
                others = tuple(watcher.states[area] for area in ("area2", "area3"))
                is_seen = "area1 is not on the bus" in watcher.obstacles()  # by the watcher, too, which is a third
                return is_seen and all(cut_off in state.notes for state in others)

            watcher.wait_until(noticed)
            reported["notes when cut off"] = {state.header.sender: state.notes for state in others}
            reported["obstacles when cut off"] = watcher.obstacles()
            run("ip", "link", "set", "to_a", "up")
            reported["gap after"] = combine(watcher.wait_for_consensus())
        reported["exit codes"] = [system.end(name) for name in reversed(list(system.processes))]
        print(json.dumps(reported))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
