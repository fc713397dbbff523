"""The simulator beside real processes over real Zenoh: the same areas, so the same answer."""

from __future__ import annotations

import csv
import random
from pathlib import Path

import numpy as np
import pytest

import coordinator
from tests.support.drawn_files import draw_scenario
from tests.support.levels import further
from tests.support.waiting import DEADLINE_S


@pytest.mark.parametrize("name", ["ieee33-lossy", *further("ieee33")])
def test_the_simulator_ends_where_real_processes_do(name: str, tmp_path: Path):
    real = coordinator.run(name, out=tmp_path / "real", strategy="information", plots=False, timeout_s=DEADLINE_S)
    simulator = coordinator.simulate(name, out=tmp_path / "simulator", strategy="information", plots=False)
    assert real.verdict.consensus
    assert simulator.verdict.consensus
    np.testing.assert_array_equal(real.comparison.centralised.vm, simulator.comparison.centralised.vm)
    np.testing.assert_allclose(real.comparison.decentralised.vm, simulator.comparison.decentralised.vm, atol=1e-8)
    np.testing.assert_allclose(real.comparison.decentralised.va, simulator.comparison.decentralised.va, atol=1e-8)
    assert real.verdict.gap_vm_pu is not None
    assert real.verdict.gap_va_deg is not None
    assert real.verdict.gap_vm_pu <= 1e-8
    assert real.verdict.gap_va_deg <= np.degrees(1e-8)
    assert real.verdict.gap_vm_pu == pytest.approx(simulator.verdict.gap_vm_pu, abs=1e-8)
    assert real.verdict.gap_va_deg == pytest.approx(simulator.verdict.gap_va_deg, abs=np.degrees(1e-8))
    assert (real.verdict.virtual_s, simulator.verdict.virtual_s is None) == (None, False)


@pytest.mark.random_cases(few=1, long=1, many=50)
def test_what_files_allow_ends_alike_on_the_simulator_and_on_processes(random_seed: int, tmp_path: Path):
    draw_scenario(tmp_path, random.Random(random_seed))
    drawn = tmp_path / "drawn.toml"
    real = coordinator.run(drawn, out=tmp_path / "real", plots=False, timeout_s=DEADLINE_S)
    simulated = coordinator.simulate(drawn, out=tmp_path / "simulated", plots=False)
    for found in (real, simulated):
        assert found.verdict.consensus
        assert {area.name: dict(area.rejected) for area in found.area_results if area.rejected} == {}
    np.testing.assert_allclose(real.comparison.decentralised.vm, simulated.comparison.decentralised.vm, atol=1e-8)


def test_compare_runs_real_processes_too(dsse, tmp_path: Path):
    both = ("--strategies", "angle-offset,information", "--processes", "--timeout", DEADLINE_S)
    done = dsse("compare", "industrial13", *both, "--out", "out")
    assert done.returncode == 0, done.stderr
    assert "real processes" in done.stdout
    with (tmp_path / "out" / "comparison.csv").open() as file:
        rows = {row["strategy"]: row for row in csv.DictReader(file)}
    assert [row["outcome"] for row in rows.values()] == ["consensus", "consensus"]
    assert float(rows["information"]["gap_vm_pu"]) <= 1e-8
    assert all((tmp_path / "out" / name / "logs" / "router.log").exists() for name in rows)
