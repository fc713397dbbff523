"""A switch of a running system: ordered while the area that holds it is killed, and again after a restart."""

from __future__ import annotations

import math
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from coordinator.lab.evaluation.comparison import compare
from coordinator.lab.evaluation.evaluation import estimate_centralised
from scenarios.files.shipped_files import find_shipped
from tests.support.dsse_command import free_endpoint
from tests.support.system_by_hand import SystemByHand, Watcher
from tests.support.waiting import DEADLINE_S

HOLDS = '[areas.area2]\nholds = ["18-33"]\n'
TIE = "from = 18, to = 33, r_ohm = 0.5, x_ohm = 0.5, "
WEAK = "from = 18, to = 33, r_ohm = 50.0, x_ohm = 50.0, switch = true, "  # the plant's grid keeps it open


@pytest.mark.long
def test_an_order_that_meets_a_kill_of_the_holder_is_followed_and_outlives_a_restart(
    dsse: Callable[..., subprocess.CompletedProcess[str]], edited_scenario: Callable[..., Path], tmp_path: Path
):
    network = find_shipped("cases")["ieee33"].read_text()
    assert TIE in network
    (tmp_path / "net.toml").write_text(network.replace(TIE, WEAK))
    path = edited_scenario("ieee33", ('network = "ieee33"', 'network = "./net.toml"'), ("[areas.area2]\n", HOLDS))
    endpoint = free_endpoint("tcp")
    assert dsse("split", str(path), "--out", "areas", "--connect", endpoint).returncode == 0
    with SystemByHand(tmp_path) as system:
        system.start("router", "router", "--listen", endpoint)
        for name in ("area1", "area2", "area3"):
            system.start(name, "agent", f"areas/{name}.toml")
        system.start("plant", "plant", path, "--connect", endpoint)
        with Watcher(str(path), [endpoint]) as watcher:
            watcher.wait_for_consensus()
            for status, is_killed_after in (("close", False), ("open", True)):
                order = "switch", status, "18-33", "--wait", DEADLINE_S, "--connect", endpoint
                system.start("operator", *order)
                if is_killed_after:
                    assert system.processes.pop("operator").wait(DEADLINE_S) == 0, system.read_log("operator")
                before = watcher.states["area2"].header.incarnation
                system.end("area2", signal.SIGKILL)
                system.start("area2", "agent", "areas/area2.toml")
                if not is_killed_after:
                    assert system.processes.pop("operator").wait(DEADLINE_S) == 0, system.read_log("operator")
                closed = {"18-33": status == "close"}
                operated = watcher.scenario.operated(closed)
                report = estimate_centralised(operated, watcher.telemetry).report

                def is_followed(closed=closed, operated=operated, report=report, before=before) -> bool:
                    state = watcher.states["area2"]
                    if watcher.obstacles() or state.header.incarnation <= before:
                        return False
                    gap = compare(operated.partition, watcher.states, None, report).gap
                    is_near = gap.vm_pu is not None and max(gap.vm_pu, math.radians(gap.va_deg or 0.0)) < 1e-9
                    return is_near and state.switches == {"18-33": "closed" if closed["18-33"] else "open"}

                watcher.wait_until(is_followed)
