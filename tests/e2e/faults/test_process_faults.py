"""What a scenario does to processes happens to real ones, and the run goes on."""

from __future__ import annotations

import json
import os
import signal

from tests.support.verdicts import assert_centralised
from tests.support.waiting import wait_until

EVENTS = """
[[faults.events]]
at_s = 0.2
kill = "area2"

[[faults.events]]
at_s = 0.6
restart = "area2"

[[faults.events]]
at_s = 0.3
pause = "area3"
for_s = 0.4

[[faults.events]]
at_s = 0.9
kill = "router"

[[faults.events]]
at_s = 1.1
restart = "router"

[[faults.events]]
at_s = 1.2
silent = "plant"
for_s = 0.3

[run]
"""


def test_a_run_ends_in_consensus_after_its_processes_were_killed_frozen_and_started_again(
    start_run, edited_scenario, assert_nothing_left
):
    scenario = edited_scenario("ieee33")
    scenario.write_text(scenario.read_text() + EVENTS)
    run = start_run(scenario)
    code, out, err = run.end()
    assert code == 0, out + err
    faults = [(e["kind"], *e["names"]) for e in run.events() if e["event"] == "fault"]
    assert sorted(faults) == [
        ("kill", "area2"),
        ("kill", "router"),
        ("pause", "area3"),
        ("restart", "area2"),
        ("restart", "router"),
        ("resume", "area3"),
        ("silent", "plant"),
        ("speak", "plant"),
    ]
    ends = [(e["name"], e["code"]) for e in run.events() if e["event"] == "process ended"]
    assert ends.count(("area2", -signal.SIGKILL)) == 1
    assert ends.count(("router", -signal.SIGKILL)) == 1
    assert sorted(name for name, code in ends if code == 0) == ["area1", "area2", "area3", "plant", "router"]
    assert_centralised(run.folder)
    assert_nothing_left(run.pids())


def test_a_plant_that_is_to_be_silent_from_the_start_is_silent_and_alive(
    start_run, edited_scenario, assert_nothing_left
):
    scenario = edited_scenario("ieee33")
    scenario.write_text(scenario.read_text() + '[[faults.events]]\nat_s = 0.0\nsilent = "plant"\nfor_s = 1.5\n')
    run = start_run(scenario)
    code, out, err = run.end()
    assert code == 0, out + err
    events = run.events()
    reported = events[: next(i for i, e in enumerate(events) if e.get("kind") == "speak")]
    assert {e["quality"] for e in {e["area"]: e for e in reported if e["event"] == "quality"}.values()} <= {
        "none",
        "stale",
    }
    assert_nothing_left(run.pids())


def test_a_run_whose_plant_died_is_no_consensus_although_the_areas_agree(
    start_run, edited_scenario, assert_nothing_left
):
    scenario = edited_scenario("ieee33")
    scenario.write_text(scenario.read_text() + '[[faults.events]]\nat_s = 10.0\nkill = "plant"\n')
    run = start_run(scenario)
    code, out, err = run.end()
    assert code == 1, out + err
    assert (
        "the areas agree, but on stale estimates: area1, area2, area3 received the last telemetry, of scan 1, " in out
    )
    result = json.loads((run.folder / "result.json").read_text())
    assert [cause["what"] for cause in result["causes"]] == ["the source of the readings (process `plant`) is gone"]
    assert {area["quality"] for area in result["areas"].values()} == {"stale"}
    assert result["verdict"]["gap_vm_pu"] <= 1e-8
    assert_nothing_left(run.pids())


def test_a_death_that_the_scenario_did_not_order_still_ends_the_run(start_run, edited_scenario, assert_nothing_left):
    scenario = edited_scenario("ieee33")
    scenario.write_text(scenario.read_text() + '[[faults.events]]\nat_s = 20.0\nkill = "area2"\n')
    run = start_run(scenario)
    run.wait_until_joined("area1", "area2", "area3")
    os.kill(run.pids()["area3"], signal.SIGKILL)
    code, out, _ = run.end()
    assert code == 1
    assert "area area3 died with signal SIGKILL" in out
    assert_nothing_left(run.pids())


def test_a_frozen_process_is_stopped_in_order_too(start_run, edited_scenario, assert_nothing_left):
    scenario = edited_scenario("ieee33")
    scenario.write_text(scenario.read_text() + '[[faults.events]]\nat_s = 0.1\npause = "area2"\nfor_s = 20.0\n')
    run = start_run(scenario)
    wait_until(lambda: any(e["event"] == "fault" for e in run.events()))
    run.process.send_signal(signal.SIGINT)
    run.end()
    ends = {e["name"]: e["code"] for e in run.events() if e["event"] == "process ended"}
    assert ends["area2"] == 0
    assert_nothing_left(run.pids())
