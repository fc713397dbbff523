"""``dsse watch`` attaches to a system that others have started, and ends without a trace."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.dsse_command import COMMAND, ENVIRONMENT, free_endpoint
from tests.support.waiting import DEADLINE_S, wait_until

AREAS = ["area1", "area2", "area3"]


def test_a_watcher_sees_a_system_whole_whose_coordinator_was_killed(start_run, dsse, assert_nothing_left):
    run = start_run("ieee33")
    run.wait_until_joined(*AREAS)
    run.process.kill()
    run.end()
    connect = ("--connect", (run.folder / "logs" / "router.endpoints").read_text().split()[0])
    seen: dict[str, dict[str, Any]] = {}

    def all_estimate() -> bool:
        done = dsse("watch", *connect, "--once", "--json")
        if done.returncode != 0:
            return False
        view = json.loads(done.stdout)
        assert view["run"] == run.events()[0]["run"]
        seen.clear()
        seen.update(view["areas"])
        return list(seen) == AREAS and all(map(agrees, seen.values()))

    wait_until(all_estimate)
    assert all(area["messages"] > 0 and area["scan"] == 1 for area in seen.values())

    def table_names_all() -> bool:
        table = dsse("watch", *connect, "--once").stdout
        return all(name in table for name in (*AREAS, "plant plant"))

    wait_until(table_names_all)
    os.kill(run.pids()["area3"], signal.SIGKILL)

    def sees_the_death() -> bool:  # a watcher that has never received the dead area itself
        areas = json.loads(dsse("watch", *connect, "--once", "--json").stdout)["areas"]
        told = [areas.get(name, {}) for name in ("area3", "area1")]
        return told[0].get("state") == "gone" and told[1].get("notes") == ["neighbour area3 is gone"]

    wait_until(sees_the_death)
    os.kill(run.pids()["parent"], signal.SIGTERM)
    assert_nothing_left(run.pids())


def agrees(area: dict[str, Any]) -> bool:
    """Whether it has nothing to remark and shows the voltages of its neighbours."""
    is_near = area["mismatch_vm_pu"] is not None and area["mismatch_vm_pu"] < 1e-6
    return is_near and area["state"] == "estimates" and area["notes"] == []


def start_watching(endpoint: str, folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*COMMAND, "watch", "--connect", endpoint, "--json"],
        cwd=folder,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture
def run(start_run, deaf_scenario):
    """A run whose two areas have joined and wait for readings."""
    run = start_run(deaf_scenario)
    run.wait_until_joined("area1", "area2")
    return run


@pytest.fixture
def watching(run, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    endpoint = (run.folder / "logs" / "router.endpoints").read_text().split()[0]
    process = start_watching(endpoint, tmp_path)
    yield process
    process.kill()
    process.wait()


def test_ctrl_c_ends_the_watching_and_nothing_else(run, watching):
    assert watching.stdout is not None
    wait_until(lambda: len(json.loads(watching.stdout.readline())["areas"]) == 2)
    watching.send_signal(signal.SIGINT)
    _, err = watching.communicate(timeout=DEADLINE_S)
    assert (watching.returncode, err) == (0, "")
    assert run.process.poll() is None
    assert not [e for e in run.events() if e["event"] == "process ended"]


def test_the_watching_ends_when_nobody_reads_it_any_more(watching):
    assert watching.stdout is not None
    assert watching.stderr is not None
    watching.stdout.readline()
    watching.stdout.close()
    assert (watching.wait(DEADLINE_S), watching.stderr.read()) == (0, "")


def test_a_pattern_is_no_run_to_watch(dsse):
    done = dsse("watch", "--run", "a/*", "--once", "--wait", "1")
    assert done.returncode == 2
    assert "'a/*' may only contain a-z, 0-9, _ and -" in done.stderr


def test_a_bus_without_a_run_and_a_bus_that_is_not_there_are_distinguished(dsse):
    endpoint = free_endpoint()
    done = dsse("watch", "--connect", endpoint, "--wait", "0.3")
    assert done.returncode == 2
    assert f"cannot reach {endpoint}" in done.stderr
    command = [sys.executable, "-m", "coordinator.lab.process_run.router_process", "--listen", endpoint]
    router = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert router.stdout is not None
        assert router.stdout.readline().startswith("listening on")
        done = dsse("watch", "--connect", endpoint, "--wait", "3")
        assert done.returncode == 2
        assert "no area publishes anything on this bus within 3 s" in done.stderr
    finally:
        router.terminate()
        assert router.wait(DEADLINE_S) == 0
