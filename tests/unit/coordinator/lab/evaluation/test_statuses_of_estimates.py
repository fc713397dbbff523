"""Statuses of switches that an estimate in one place is told, and one that its readings contradict."""

from __future__ import annotations

import numpy as np
import pytest

from coordinator.cli.main import run_command
from coordinator.lab.evaluation.scan_estimates import estimate_whole_grid, operate, operate_scans, with_one_scan
from dsse_core.errors import InvalidInputError
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


def test_a_branch_that_is_no_switch_and_a_switch_of_two_statuses_are_refused_together():
    with pytest.raises(InvalidInputError) as refused:
        operate(tied33(3, (), switches=("18-33",)), ("7-8", "18-33"), ("18-33",))
    first, second = refused.value.problems
    assert first.startswith("there is no switch '7-8'; switches are 18-33; ")
    assert second == "switch 18-33 is to be open and closed"


def test_the_command_names_all_wrong_switches_at_once(capsys: pytest.CaptureFixture[str]):
    assert run_command(["estimate", "ieee33", "--open", "none", "--close", "nowhere"]) == 2
    written = capsys.readouterr().err
    assert "no switch 'none'" in written
    assert "no switch 'nowhere'" in written
