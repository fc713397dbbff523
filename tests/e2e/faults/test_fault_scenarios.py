"""The shipped scenarios with faults, on real processes and on the simulator: the same faults, the same end."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest

import coordinator
from coordinator.lab.evaluation.result import RunResult
from coordinator.lab.process_run.compile_clock import clock
from coordinator.show.report.text import format_verdict
from coordinator.watch.observe.progress import Progress
from tests.support.waiting import DEADLINE_S

KINDS = {
    "ieee33-bursts": {"lost in a burst"},
    "ieee33-disorder": {"delayed", "overtaken", "duplicated"},
    "ieee33-corruption": {"corrupted"},
    "ieee33-cut": {"cut", "heal", "lost in a cut"},
    "ieee33-restart": {"kill", "restart"},
}
RUNS = {"processes": coordinator.run, "simulator": coordinator.simulate}
GAP = 1e-8  # p.u. and rad
SETTLED_S = 5.0  # from the report of a death until its neighbours have learned of it, too, and theirs


def events_of(result: RunResult, kind: str) -> list[dict]:
    lines = (result.folder / "events.jsonl").read_text().splitlines()
    return [event for event in map(json.loads, lines) if event["event"] == kind]


@pytest.mark.parametrize(
    ("name", "run"),
    [
        *(pytest.param(name, coordinator.simulate, id=f"{name}-simulator") for name in KINDS),
        pytest.param("ieee33-restart", coordinator.run, id="ieee33-restart-processes"),
        *(
            pytest.param(name, coordinator.run, id=f"{name}-processes", marks=pytest.mark.long)
            for name in KINDS
            if name != "ieee33-restart"
        ),
    ],
)
def test_faults_delay_the_centralised_estimate_and_are_counted(
    name: str, run: Callable[..., RunResult], tmp_path: Path
):
    result = run(name, out=tmp_path / "out", plots=False, timeout_s=DEADLINE_S)
    assert result.verdict.consensus, result.verdict.reason
    assert result.verdict.gap_vm_pu is not None
    assert result.verdict.gap_vm_pu <= GAP
    assert KINDS[name] <= result.faults.keys()
    qualities = {area.quality for area in result.area_results}
    assert qualities == {"good"} or (
        run is coordinator.run and qualities <= {"good", "degraded"}
    )  # as the last message was lost
    written = json.loads((tmp_path / "out" / "result.json").read_text())
    assert written["faults"] == dict(result.faults)
    assert "faults: " in format_verdict(result)
    reported = {key for event in events_of(result, "link faults") for key in event} | {
        event["kind"] for event in events_of(result, "fault")
    }
    assert KINDS[name] <= reported


def test_a_liar_is_named_and_there_is_neither_consensus_nor_a_good_state_of_who_receives_it(tmp_path: Path):
    result = coordinator.simulate("ieee33-liar", out=tmp_path / "out", plots=False)
    assert not result.verdict.consensus
    assert "area1 and area3 differ" in str(result.verdict.reason)
    first_line, *others = format_verdict(result).splitlines()
    assert ": the estimates of area1 and area3 disagree at bus 6 by 0.0143 p.u. since " in first_line
    assert "effects: area1, area2, area3 are degraded" in map(str.strip, others)
    assert result.faults["lied"] > 0
    (receives,) = [area for area in result.area_results if area.name == "area1"]
    assert receives.quality == "degraded"
    assert any("boundary mismatch with area3" in note for note in receives.notes)


def test_damaged_messages_are_rejected_and_counted_by_reason(tmp_path: Path):
    result = coordinator.simulate("ieee33-corruption", out=tmp_path / "out", plots=False)
    rejected = sum(area.rejected.get("damaged", 0) for area in result.area_results)
    assert 0 < rejected <= result.faults["corrupted"]


def test_missing_and_late_readings_are_the_same_for_plant_areas_and_the_centralised_estimate(tmp_path: Path):
    from scenarios.scenario import load_scenario

    changes = {"faults.telemetry": {"missing": 0.05, "late": 1.0, "late_s": 0.5}}
    for run in RUNS.values():
        scenario = load_scenario("ieee33", changes=changes)
        result = run(scenario, out=tmp_path / run.__name__, plots=False, timeout_s=DEADLINE_S)
        assert result.verdict.consensus, result.verdict.reason
        assert result.verdict.gap_vm_pu is not None
        assert result.verdict.gap_vm_pu <= GAP
        assert any("no reading from" in note for area in result.area_results for note in area.notes)


@pytest.mark.parametrize(
    "run",
    [
        pytest.param(coordinator.simulate, id="simulator"),
        pytest.param(coordinator.run, id="processes", marks=pytest.mark.long),
    ],
)
def test_an_area_killed_at_last_is_missed_and_its_last_state_is_not_called_good(
    run: Callable[..., RunResult], edited_scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The limit of real processes passes some time after that death has been reported, however long that takes."""
    gone = "area2 is not on the bus"
    seen_at: list[float] = []

    def pass_when_reported(progress: Progress) -> None:
        if progress.obstacles == (gone,) and all(area.messages for area in progress.areas):
            seen_at.append(progress.elapsed_s)
            if progress.elapsed_s > seen_at[0] + SETTLED_S:
                monkeypatch.setattr(clock, "find_start", lambda _: -math.inf)

    scenario = edited_scenario("ieee33")
    scenario.write_text(scenario.read_text() + '[[faults.events]]\nat_s = 8.0\nkill = "area2"\n')
    options = {"on_update": pass_when_reported} if run is coordinator.run else {}
    result = run(scenario, out=tmp_path / "out", plots=False, timeout_s=DEADLINE_S, **options)
    assert result.verdict.reason == f"no consensus within {DEADLINE_S:g} s: {gone}"
    (cause,) = result.causes
    assert (cause.what, cause.areas) == ("the agent of area2 is gone", ("area2",))
    assert json.loads((tmp_path / "out" / "result.json").read_text())["causes"][0]["what"] == cause.what
    assert {area.name: area.quality for area in result.area_results} == {
        "area1": "degraded",
        "area2": "stale",
        "area3": "degraded",  # which learns from area1 that something is old
    }
