"""No start order is assumed: whoever is there first waits for the others, and nothing is said too early."""

from __future__ import annotations

import math
from pathlib import Path

import psutil
import pytest

from tests.support.dsse_command import free_endpoint
from tests.support.system_by_hand import SystemByHand, Watcher
from tests.support.waiting import DEADLINE_S, wait_until

THREADS_OF_A_BUS = 2  # a process with more has imported all, and looks for the bus or is on it
ORDERS = (
    ("area3", "plant", "area1", "area2", "router"),
    ("plant", "area2", "router", "area3", "area1"),
)


@pytest.mark.parametrize("order", ORDERS, ids="-".join)
def test_a_system_started_one_after_the_other_agrees_whoever_is_first(dsse, tmp_path: Path, order: tuple[str, ...]):
    endpoint = free_endpoint()
    assert dsse("split", "ieee33", "--out", "areas", "--connect", endpoint).returncode == 0
    commands: dict[str, tuple[object, ...]] = {
        "router": ("router", "--listen", endpoint),
        "plant": ("plant", "ieee33", "--connect", endpoint, "--wait", str(DEADLINE_S)),
        **{f"area{i}": ("agent", f"areas/area{i}.toml", "--wait", str(DEADLINE_S)) for i in (1, 2, 3)},
    }
    with SystemByHand(tmp_path) as system:
        for name in order:
            system.start(name, *commands[name])
            process = psutil.Process(system.processes[name].pid)
            wait_until(lambda process=process: process.num_threads() > THREADS_OF_A_BUS)
        with Watcher("ieee33", [endpoint]) as watcher:
            gap = watcher.wait_for_consensus()
        assert gap.vm_pu is not None
        assert gap.va_deg is not None
        assert gap.vm_pu <= 1e-8
        assert gap.va_deg <= math.degrees(1e-8)
        assert [system.end(name) for name in sorted(commands)] == [0] * len(commands)
