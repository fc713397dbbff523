"""Statuses of switches that an estimate in one place is told, and one that its readings contradict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coordinator.cli.main import run_command
from coordinator.lab.evaluation.answers import report_as_json
from coordinator.lab.evaluation.scan_estimates import (
    estimate_scans,
    estimate_whole_grid,
    operate,
    operate_scans,
    with_one_scan,
)
from coordinator.show.report.grid_text import format_bad_data
from dsse_core.errors import InvalidInputError
from dsse_core.results.results import results_of_estimate
from scenarios.files.readings.file import Scans
from scenarios.telemetry import make_telemetry
from tests.support.rings import TIES, tied33


def test_readings_of_a_grid_with_a_closed_tie_name_it_unless_it_is_stated():
    scenario = tied33(3, (), switches=TIES)
    real = [m for m in make_telemetry(scenario, closed={"18-33": True}).union if m.sigma]
    values, sigmas = (np.array([[getattr(m, name) for m in real]]) for name in ("value", "sigma"))
    scans = Scans(("",), tuple(m.meter for m in real), values, sigmas)
    for closed, named in (((), ["18-33"]), (("18-33",), [])):
        stated = operate(scenario, (), closed)
        report, _ = estimate_whole_grid(with_one_scan(stated, operate_scans(scans, stated.network)))
        assert [*report.switched] == named
        assert report.result.network.switches["18-33"]
        assert not report.detected
        assert report.removed == ()


def test_a_section_that_an_opened_switch_leaves_without_supply_is_0_in_the_tables_of_one_scan_and_of_many():
    scenario = operate(tied33(3, (), switches=("7-8",)), ("7-8",), ())
    report, truth = estimate_whole_grid(scenario)
    tables = results_of_estimate(report, partition=scenario.partition, meters=scenario.meters, truth=truth)
    is_dead = np.isin(tables.buses.bus, range(8, 19))
    for name in ("vm_pu", "sigma_vm_pu", "p_kw", "sigma_p_kw", "true_vm_pu"):
        assert ((tables.buses[name] == 0.0) == is_dead).all()
    assert not np.isnan(tables.areas.sigma_load_kw).any()
    said = format_bad_data(report)
    assert "without supply, shown as 0 p.u.: bus 8-18; open around: 12-22, 18-33, 21-8, 7-8, 9-15" in said
    assert report_as_json(report)["without_supply"] == ["8-18"]
    dead = [m for m, status in zip(tables.meters.meter, tables.meters.status, strict=True) if status == "silent: dead"]
    assert sorted(dead) == sorted(meter.id for meter in scenario.meters if 8 <= meter.bus <= 18)
    real = [m for m in make_telemetry(scenario).union if m.sigma]
    values, sigmas = (np.array([[getattr(m, name) for m in real]] * 2) for name in ("value", "sigma"))
    scans = Scans(("1", "2"), tuple(m.meter for m in real), values, sigmas)
    of_many = estimate_scans(scenario, scans).tables
    assert of_many.buses.vm_pu[:33] == pytest.approx(tables.buses.vm_pu, abs=1e-9)
    assert sorted(
        {m for m, s in zip(of_many.meters.meter, of_many.meters.status, strict=True) if "dead" in s}
    ) == sorted(dead)
    assert (of_many.scans.lowest_vm_pu > 0.9).all()


def test_a_branch_that_is_no_switch_and_a_switch_of_two_statuses_are_refused_together():
    with pytest.raises(InvalidInputError) as refused:
        operate(tied33(3, (), switches=("18-33",)), ("7-8", "18-33"), ("18-33",))
    first, second = refused.value.problems
    assert first.startswith("there is no switch '7-8'; switches are 18-33; ")
    assert second == "switch 18-33 is to be open and closed"


def test_a_switch_is_named_by_its_id_or_by_a_name_that_one_branch_alone_has():
    scenario = tied33(3, (), switches=("7-8", "18-33"))
    called = {"7-8": "Sw1", "18-33": "twice", "21-8": "twice"}
    branches = [replace(b, name=called.get(b.id, "")) for b in scenario.network.branches]
    named = replace(scenario, network=replace(scenario.network, branches=tuple(branches)))
    assert operate(named, ("sw1",), ()).network.switches == operate(named, ("7-8",), ()).network.switches
    with pytest.raises(InvalidInputError, match="2 branches are called 'twice'; give the id of one: 21-8, 18-33"):
        operate(named, ("twice",), ())
    with pytest.raises(InvalidInputError, match="there is no switch 'sw2'; did you mean 'Sw1'"):
        operate(named, ("sw2",), ())


def test_the_command_names_all_wrong_switches_at_once(capsys: pytest.CaptureFixture[str]):
    assert run_command(["estimate", "ieee33", "--open", "none", "--close", "nowhere"]) == 2
    written = capsys.readouterr().err
    assert "no switch 'none'" in written
    assert "no switch 'nowhere'" in written
