"""A feeder is upgraded process by process: each is started again by another environment, beside those not yet changed.

``DSSE_OTHER_PYTHON``: the interpreter of an environment with other versions of the libraries, as ``.ci/lowest`` has;
without it the other environment is a new one with the versions of this one.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import pytest

from agents.messages.packing import StateMessage
from tests.support.dsse_command import ENVIRONMENT, free_endpoint
from tests.support.system_by_hand import SystemByHand, Watcher

OTHER = "DSSE_OTHER_PYTHON"
AREAS = ("area1", "area2", "area3")
LEASE_S = 2.0  # after which a lost link is noticed at the latest
PACKAGES = ("eclipse-zenoh", "msgpack", "msgspec", "numpy", "pydantic", "scipy")


def versions_of(python: Path) -> dict[str, str]:
    """Of the libraries that meet in messages and in the numbers of an area."""
    script = "import json, sys; from importlib.metadata import version as v; "
    script += "print(json.dumps({name: v(name) for name in sys.argv[1:]}))"
    done = subprocess.run(
        [python, "-c", script, *PACKAGES], env=ENVIRONMENT, capture_output=True, text=True, check=True
    )
    return dict(json.loads(done.stdout))


@pytest.fixture
def other_python(tmp_path: Path) -> Path:
    if given := os.environ.get(OTHER):
        assert versions_of(Path(given)) != versions_of(Path(sys.executable)), f"{OTHER} has the versions of this one"
        return Path(given)
    folder = tmp_path / "environment"
    venv.create(folder)
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "installed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "bin" / "python"


@pytest.mark.long
def test_a_feeder_is_upgraded_area_by_area_and_never_disagrees(dsse, tmp_path: Path, other_python: Path):
    endpoint = free_endpoint()
    assert dsse("split", "ieee33", "--out", "areas", "--connect", endpoint).returncode == 0
    commands = {
        "router": ("router", "--listen", endpoint),
        **{name: ("agent", f"areas/{name}.toml") for name in AREAS},
        "plant": ("plant", "ieee33", "--connect", endpoint),
    }
    with SystemByHand(tmp_path) as system:
        for name, command in commands.items():
            system.start(name, *command)
        with Watcher("ieee33", [endpoint]) as watcher:
            assert max(gap_of(watcher)) <= 1e-8
            for name in (*AREAS, "plant", "router"):
                before, others = dict(watcher.states), [area for area in AREAS if area != name]
                assert system.end(name) == 0
                system.start(name, *commands[name], python=other_python)
                watcher.wait_until(partial(is_back, system, watcher, name, before))
                assert max(gap_of(watcher)) <= 1e-8, name
                states = watcher.states
                assert all(states[area].header.incarnation == before[area].header.incarnation for area in others)
                if name in AREAS:  # of a new plant they may reject for a moment what one of them knew before the others
                    assert [states[area].rejected for area in AREAS] == [{}] * len(AREAS)
        assert [system.end(name) for name in reversed(commands)] == [0] * len(commands)


def gap_of(watcher: Watcher) -> tuple[float, float]:
    """Largest differences to the centralised estimate, p.u. and degrees."""
    gap = watcher.wait_for_consensus()
    assert gap.vm_pu is not None
    assert gap.va_deg is not None
    return gap.vm_pu, gap.va_deg


def is_back(system: SystemByHand, watcher: Watcher, name: str, before: Mapping[str, StateMessage]) -> bool:
    """Whether the new process ``name`` does its work, and all areas are good with it."""
    states = watcher.states
    if name == "plant":  # its readings have numbers above those of the former one
        is_new = all(states[area].header.scan > before[area].header.scan for area in AREAS)
    elif name == "router":  # what all areas say has passed it
        is_new = system.read_log(name).count("listening on") == 2 and all(
            states[area].header.time > before[area].header.time + LEASE_S for area in AREAS
        )
    else:
        is_new = states[name].header.incarnation > before[name].header.incarnation
    return is_new and all(state.quality == "good" for state in states.values()) and not watcher.obstacles()
