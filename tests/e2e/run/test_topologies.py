"""A run on direct links between neighbours, with no router, and one through two routers of which one dies."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path

import pytest

from agents.area_files.reader import load_area_file
from tests.support.dsse_command import COMMAND, ENVIRONMENT
from tests.support.verdicts import assert_centralised
from tests.support.waiting import DEADLINE_S, wait_until

RESTARTS = """
[[faults.events]]
at_s = 0.2
kill = "area1"

[[faults.events]]
at_s = 0.5
restart = "area1"

[transport]
kind = "neighbours"
"""


@pytest.mark.parametrize(
    "options", [pytest.param((), id="open"), pytest.param(("--secure",), id="secured", marks=pytest.mark.long)]
)
def test_neighbours_need_no_router_even_if_the_one_they_all_link_with_dies_and_comes_back(
    start_run, edited_scenario, assert_nothing_left, options: tuple[str, ...]
):
    scenario = edited_scenario("ieee33")
    scenario.write_text(scenario.read_text() + RESTARTS)
    run = start_run(scenario, *options)
    code, out, err = run.end()
    assert code == 0, out + err
    assert "router" not in run.pids()
    assert_centralised(run.folder)
    assert_nothing_left(run.pids())


@pytest.mark.long
def test_either_of_two_linked_routers_may_die_and_come_back(start_run, edited_scenario, assert_nothing_left):
    scenario = edited_scenario("ieee33")
    deaths = [
        ("kill", "router", 0.2),
        ("restart", "router", 0.8),
        ("kill", "router2", 1.1),
        ("restart", "router2", 1.6),
    ]
    deaths += [("kill", "area2", 1.8), ("restart", "area2", 1.9)]
    events = "".join(f'[[faults.events]]\nat_s = {at}\n{kind} = "{name}"\n' for kind, name, at in deaths)
    scenario.write_text(scenario.read_text() + events + "[transport]\nrouters = 2\n")
    run = start_run(scenario)
    code, out, err = run.end()
    assert code == 0, out + err
    ends = [(e["name"], e["code"]) for e in run.events() if e["event"] == "process ended"]
    for name in ("router", "router2"):
        assert [code for ended, code in ends if ended == name] == [-signal.SIGKILL, 0]
    assert_centralised(run.folder)
    assert_nothing_left(run.pids())


def test_area_files_of_neighbours_run_by_hand_with_a_watcher(dsse, edited_scenario, tmp_path: Path):
    scenario = edited_scenario("industrial13")
    scenario.write_text(scenario.read_text() + '[transport]\nkind = "neighbours"\n')
    assert dsse("split", scenario, "--out", "areas").returncode == 0
    files = sorted((tmp_path / "areas").glob("*.toml"))
    connect = [part for path in files for part in ("--connect", *load_area_file(path).listen)]
    processes = [subprocess.Popen([*COMMAND, "plant", str(scenario), *connect], env=ENVIRONMENT)]
    processes += [subprocess.Popen([*COMMAND, "agent", str(path)], env=ENVIRONMENT) for path in files]
    try:

        def all_estimate() -> bool:
            done = dsse("watch", "--direct", *connect, "--once", "--json")
            areas = json.loads(done.stdout)["areas"] if done.returncode == 0 else {}
            return len(areas) == len(files) and all(area["state"] == "estimates" for area in areas.values())

        wait_until(all_estimate)
        for process in processes:
            process.send_signal(signal.SIGTERM)
            assert process.wait(DEADLINE_S) == 0
    finally:
        for process in processes:
            process.kill()
            process.wait()
