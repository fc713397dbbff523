"""Radial networks of MATPOWER and pandapower, and the number of areas that each is cut into."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scenarios.importers import import_grid
from scenarios.importers.imported_files import write_imported
from scenarios.scenario import Scenario, load_scenario

MATPOWER = {
    **dict.fromkeys(["4_dist"], 2),
    **dict.fromkeys(["10ba", "12da", "15da", "15nbr", "16am", "17me", "18", "18nbr", "22", "28da"], 4),
    **dict.fromkeys(["33bw", "33mg", "34sa", "38si", "51ga", "51he", "69", "74ds", "85", "94pi"], 4),
    **dict.fromkeys(["118zh", "136ma", "141"], 8),
    **dict.fromkeys(["533mt_hi", "533mt_lo"], 16),
    "1197": 32,
}
"""Case -> number of areas. case16am has a branch without impedance."""
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
