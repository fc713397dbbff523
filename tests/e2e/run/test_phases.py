"""The unbalanced feeders as real processes over real Zenoh."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

import coordinator
from dsse_core.errors import InvalidInputError
from scenarios.scenario import load_scenario
from tests.support.levels import further
from tests.support.waiting import DEADLINE_S

RESTART = [{"at_s": 0.3, "kill": "area2"}, {"at_s": 0.8, "restart": "area2"}]
FAULTY = [
    ("ieee13", {"faults.loss": 0.3, "faults.events": RESTART}),
    ("ieee123", {}),
    ("ieee123", {"faults.loss": 0.6, "faults.events": RESTART}),
]


@pytest.mark.parametrize("changed", [("ieee13", {}), *further(*FAULTY)])
def test_areas_agree_with_the_centre_in_every_phase(changed: tuple[str, dict[str, Any]], tmp_path: Path):
    name, changes = changed
    scenario = load_scenario(name, changes=changes)
    result = coordinator.run(scenario, out=tmp_path / "out", timeout_s=DEADLINE_S)
    assert result.verdict.consensus, result.verdict.reason
    assert result.verdict.gap_vm_pu is not None
    assert result.verdict.gap_vm_pu < 1e-9
    silences = {"degraded"} if changes.get("faults.loss", 0.0) > 0.5 else set[str]()  # of neighbours, at the verdict
    assert {area.quality for area in result.area_results} - silences == {"good"}
    assert all(area.fresh for area in result.area_results)
    assert (result.verdict.lost > 0, result.faults.get("restart", 0)) == (bool(changes), len(changes) // 2)
    with (result.folder / "buses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [f"{row['bus']}.{row['phase']}" for row in rows] == scenario.network.node_names
    assert (result.folder / "magnitudes.png").stat().st_size > 0


def test_a_strategy_of_one_voltage_a_bus_is_refused_before_any_process_starts(tmp_path: Path):
    with pytest.raises(InvalidInputError, match="buses have phases, which strategy 'angle-offset' cannot"):
        coordinator.run("ieee13", out=tmp_path / "out", strategy="angle-offset")
    assert not (tmp_path / "out").exists()
