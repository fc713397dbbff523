"""How a run of many areas starts: the agents first, then the readings and the plant."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import coordinator
from tests.support.levels import further
from tests.support.waiting import DEADLINE_S


def test_where_areas_are_many_the_plant_starts_when_all_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("coordinator.lab.process_run.run_scenario.MANY_AREAS", 2)
    result = coordinator.run("industrial13", out=tmp_path / "out", plots=False, timeout_s=DEADLINE_S)
    assert result.verdict.consensus, result.verdict.reason
    events = [json.loads(line) for line in (tmp_path / "out" / "events.jsonl").read_text().splitlines()]
    seen = [(event["event"], event.get("name")) for event in events]
    plant = seen.index(("process started", "plant"))
    areas = [area.name for area in result.scenario.partition.areas]
    assert all(("appeared", area) in seen[:plant] for area in areas)


def test_who_is_there_begins_when_others_have_not_joined_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("coordinator.lab.process_run.run_scenario.MANY_AREAS", 2)
    monkeypatch.setattr("coordinator.lab.process_run.run_scenario.JOIN_SHARE", 0.0)
    result = coordinator.run("industrial13", out=tmp_path / "out", plots=False, timeout_s=DEADLINE_S)
    assert result.verdict.consensus, result.verdict.reason


def test_an_interrupt_before_all_have_joined_leaves_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupt(_: object) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr("coordinator.lab.process_run.run_scenario.MANY_AREAS", 2)
    monkeypatch.setattr("coordinator.lab.process_run.run_scenario._is_time_to_begin", interrupt)
    with pytest.raises(KeyboardInterrupt):
        coordinator.run("industrial13", out=tmp_path / "out", plots=False, timeout_s=DEADLINE_S)
    assert json.loads((tmp_path / "out" / "result.json").read_text())["verdict"]["reason"] == "interrupted"


def test_the_centralised_estimate_takes_no_core_from_many_areas_that_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("coordinator.lab.process_run.run_scenario.MANY_AREAS", 2)
    result = coordinator.run("industrial13", out=tmp_path / "out", plots=False, timeout_s=DEADLINE_S)
    assert result.verdict.gap_vm_pu is not None
    assert result.verdict.gap_vm_pu < 1e-6
    assert result.timing_s["centralised_estimated"] >= result.timing_s["verdict"]


@pytest.mark.parametrize("many_areas", [2, *further(50)])
def test_an_interrupt_while_the_centralised_estimate_is_made_keeps_what_the_areas_have_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, many_areas: int
):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("coordinator.lab.process_run.run_scenario.MANY_AREAS", many_areas)
    monkeypatch.setattr("coordinator.lab.process_run.run_scenario.estimate_centralised", interrupt)
    with pytest.raises(KeyboardInterrupt):
        coordinator.run("industrial13", out=tmp_path / "out", plots=False)
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["verdict"]["consensus"]
    assert result["centralised"] == {"failure": "interrupted"}
    assert (tmp_path / "out" / "buses.csv").exists()
