"""Two agents of one area, or two plants: every watcher is informed, and the older one gives way."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from agents.messages.keys import live_key
from agents.runtime.duplicate_guard import REPLACED_CODE
from agents.runtime.presence import begin_incarnation
from agents.transport.zenoh_bus import Session
from tests.support.dsse_command import COMMAND, ENVIRONMENT, free_endpoint
from tests.support.levels import SECURED_FURTHER
from tests.support.system_by_hand import SystemByHand, agreeing_system
from tests.support.waiting import DEADLINE_S, wait_until


@pytest.mark.parametrize("secured", SECURED_FURTHER)
def test_the_older_agent_and_the_older_plant_give_way_and_the_estimate_stays(dsse, tmp_path: Path, secured: bool):
    with agreeing_system(dsse, tmp_path, secured) as (system, watcher, endpoint, keys):
        system.start("area2 again", "agent", "areas/area2.toml", *keys)
        system.start("plant again", "plant", "industrial13", "--connect", endpoint, *keys)
        for name, whom in (("area2", "area area2 of run industrial13"), ("plant", "plant of run industrial13")):
            process = system.processes[name]
            watcher.wait_until(lambda process=process: process.poll() is not None)
            assert process.returncode == REPLACED_CODE
            assert f"error: two processes run as {whom} at once" in system.read_log(name)
        watcher.wait_for_consensus()
        assert all(system.processes[f"{name} again"].poll() is None for name in ("area2", "plant"))


def test_a_watcher_that_comes_later_is_told_while_both_are_there(dsse, tmp_path: Path):
    endpoint, run = free_endpoint(), "industrial13"
    with SystemByHand(tmp_path) as system:
        system.start("router", "router", "--listen", endpoint)
        with Session.connect([endpoint], DEADLINE_S) as one, Session.connect([endpoint], DEADLINE_S) as other:
            for session in (one, other):  # neither gives way
                session.declare_presence(live_key(run, "area", "area2", begin_incarnation()))

            def is_shown() -> bool:
                done = dsse("watch", run, "--connect", endpoint, "--run", run, "--once", "--json", "--wait", "2")
                shown = json.loads(done.stdout)["duplicates"] if done.stdout else []
                return any("2 agents of area area2 publish at once" in line for line in shown)

            wait_until(is_shown)


def test_a_run_whose_area_runs_twice_says_so_with_both_incarnations(start_run, deaf_scenario, assert_nothing_left):
    run = start_run(deaf_scenario)
    run.wait_until_joined("area1", "area2")
    command = [*COMMAND, "agent", str(run.folder / "areas" / "area2.json")]
    stranger = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        code, out, _ = run.end()
    finally:
        stranger.terminate()
        stranger.wait(DEADLINE_S)
    assert code == 1
    assert "area area2 died with exit code 3" in out
    assert "error: two processes run as area area2" in out
    assert "warning: 2 agents of area area2 publish at once" in out
    (event,) = (e for e in run.events() if e["event"] == "two at once")
    (duplicate,) = json.loads((run.folder / "result.json").read_text())["duplicates"]
    assert duplicate == {key: event[key] for key in ("role", "name", "older", "newer")}
    assert (duplicate["role"], duplicate["name"]) == ("area", "area2")
    assert duplicate["older"] < duplicate["newer"]
    assert_nothing_left(run.pids())
