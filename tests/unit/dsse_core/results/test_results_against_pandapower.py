"""Flows, currents, losses, loading and injections are pandapower's, to 1e-6 in its units."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsse_core.power_flow.newton_raphson import solve_power_flow
from dsse_core.results.results import results_of_power_flow
from dsse_core.results.table import Table
from scenarios.files.network_file import load_network
from scenarios.files.saved_network import save_network
from scenarios.importers import import_grid
from tests.support.pandapower_tables import ONE_WORKER, LoadedLate

pp: Any = LoadedLate("pandapower")
networks: Any = LoadedLate("pandapower.networks")

pytestmark = [
    ONE_WORKER,
    pytest.mark.filterwarnings("ignore::Warning:pandapower", "ignore::Warning:pandas"),
    pytest.mark.slow,
]
ENDS = {"line": ("from", "to"), "trafo": ("hv", "lv")}
QUANTITY = {"p": ("p_{}_kw", 1e3, "mw"), "q": ("q_{}_kvar", 1e3, "mvar"), "i": ("i_{}_a", 1e3, "ka")}


def cigre_with_taps_and_shunts() -> Any:
    net = networks.create_cigre_network_mv(with_der="pv_wind")
    net.trafo["tap_side"], net.trafo["tap_neutral"], net.trafo["tap_step_percent"] = "hv", 0, 1.25
    net.trafo["tap_pos"], net.trafo["tap_changer_type"], net.trafo["tap_step_degree"] = [3, -2], "Ratio", 0.0
    pp.create_shunt(net, 5, -0.8, 0.05, step=2)
    pp.create_shunt(net, 9, 0.3)
    return net


def net_of_everything() -> Any:
    """Load, shunt and generation at the substation; sources at load buses; three voltages; what is out of service."""
    net = pp.create_empty_network(sn_mva=3.0)
    top, far = pp.create_bus(net, 110), pp.create_bus(net, 110)
    near, middle, end = (pp.create_bus(net, 20) for _ in range(3))
    low = pp.create_bus(net, 0.4)
    pp.create_ext_grid(net, top, 1.03, va_degree=7)
    pp.create_load(net, top, 5, 1)
    pp.create_shunt(net, top, -2, 0.3)
    pp.create_sgen(net, top, 1.0, 0.2)
    pp.create_transformer(net, top, near, "40 MVA 110/20 kV", tap_pos=4)
    pp.create_transformer(net, top, near, "40 MVA 110/20 kV", tap_pos=2, parallel=2, df=0.7)
    pp.create_transformer(net, middle, low, "0.63 MVA 20/0.4 kV", tap_pos=-1)
    pp.create_transformer(net, middle, low, "0.63 MVA 20/0.4 kV", in_service=False)
    pp.create_line(net, near, middle, 1.3, "NA2XS2Y 1x185 RM/25 12/20 kV", parallel=3)
    pp.create_line(net, near, middle, 1.1, "NA2XS2Y 1x185 RM/25 12/20 kV", in_service=False)
    pp.create_line(net, middle, end, 1.1, "48-AL1/8-ST1A 20.0")
    pp.create_line(net, top, far, 10, "149-AL1/24-ST1A 110.0")
    pp.create_load(net, end, 1, 0.3)
    pp.create_gen(net, end, 2.0, vm_pu=1.01)
    pp.create_storage(net, end, 0.2, 1, 0.05)
    pp.create_load(net, low, 0.3, 0.1)
    pp.create_shunt(net, low, 0.05, 0.01)
    pp.create_gen(net, far, 3, 1.02)
    pp.create_load(net, far, 4, 1, scaling=0.5)
    return net


def random_net(seed: int) -> Any:
    """10 to 40 buses: parallel lines, a loop or none, transformers with taps, shunts, lines out of service."""
    rng = np.random.default_rng(seed)
    net = pp.create_empty_network(sn_mva=float(rng.choice([1.0, 10.0, 100.0])))
    top = pp.create_bus(net, 110)
    pp.create_ext_grid(net, top, vm_pu=rng.uniform(0.98, 1.04), va_degree=rng.uniform(-10, 10))
    buses = []
    for _ in range(int(rng.integers(1, 3))):
        buses.append(pp.create_bus(net, 20))
        tap = int(rng.integers(-6, 7))
        pp.create_transformer(net, top, buses[-1], "40 MVA 110/20 kV", tap_pos=tap, parallel=int(rng.integers(1, 3)))
    for _ in range(int(rng.integers(8, 38))):
        near = int(rng.choice(buses))
        buses.append(pp.create_bus(net, 20))
        kind = str(rng.choice(["NA2XS2Y 1x185 RM/25 12/20 kV", "48-AL1/8-ST1A 20.0"]))
        pp.create_line(net, near, buses[-1], rng.uniform(0.1, 2), kind, parallel=int(rng.integers(1, 3)), df=0.8)
        pp.create_load(net, buses[-1], rng.uniform(0, 0.4), rng.uniform(-0.05, 0.2))
    for _ in range(int(rng.integers(0, 3))):
        one, other = (int(bus) for bus in rng.choice(buses, 2, replace=False))
        pp.create_line(net, one, other, 3.0, "NA2XS2Y 1x185 RM/25 12/20 kV", in_service=bool(rng.random() < 0.5))
    for bus in rng.choice(buses, 2, replace=False).tolist():
        pp.create_shunt(net, bus, rng.uniform(-1, 1), rng.uniform(0, 0.1))
        pp.create_sgen(net, bus, rng.uniform(0, 1), 0.0)
    return net


NETS: dict[str, Callable[[], Any]] = {"case33bw": lambda: networks.case33bw(), "CIGRE MV": cigre_with_taps_and_shunts}
NETS["everything"] = net_of_everything
NETS |= {f"random {seed}": lambda seed=seed: random_net(seed) for seed in range(20)}
FEW = ("case33bw", "CIGRE MV", "everything", "random 0", "random 1")


@pytest.mark.parametrize("name", [n if n in FEW else pytest.param(n, marks=pytest.mark.long) for n in NETS])
def test_what_flows_is_what_pandapower_finds(tmp_path: Path, name: str) -> None:
    net = NETS[name]()
    for element in ENDS:
        net[element]["name"] = [f"{element} {index}" for index in net[element].index]
    pp.to_json(net, str(tmp_path / "net.json"))
    imported = import_grid(tmp_path / "net.json").network
    save_network(tmp_path / "network.toml", imported, "pandapower")
    network = load_network(tmp_path / "network.toml")  # names and ratings are kept
    results = results_of_power_flow(solve_power_flow(network, tolerance=1e-12))
    pp.runpp(net, calculate_voltage_angles=True, tolerance_mva=1e-10, trafo_loading="power", numba=False)
    for element, ends in ENDS.items():
        check_branches(net, element, ends, results.branches)
    check_buses(net, results.buses)


def check_branches(net: Any, element: str, ends: tuple[str, str], branches: Table) -> None:
    row_of = {called: row for row, called in enumerate(branches.name)}
    shown = [index for index in net[element].index if f"{element} {index}" in row_of]
    assert len(shown) >= 0.8 * net[element].in_service.sum()  # without those open at one end
    rows = [row_of[f"{element} {index}"] for index in shown]
    theirs = net[f"res_{element}"].loc[shown]
    for ours, end in zip(("from", "to"), ends, strict=True):
        for symbol, (column, size, unit) in QUANTITY.items():
            found = branches[column.format(ours)][rows] / size
            np.testing.assert_allclose(found, theirs[f"{symbol}_{end}_{unit}"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(branches.loss_kw[rows] / 1e3, theirs.pl_mw, rtol=0, atol=1e-6)
    np.testing.assert_allclose(branches.loss_kvar[rows] / 1e3, theirs.ql_mvar, rtol=0, atol=1e-6)
    np.testing.assert_allclose(branches.loading_percent[rows], theirs.loading_percent, rtol=0, atol=1e-6)


def check_buses(net: Any, buses: Table) -> None:
    """pandapower counts consumption positive, and shunts as consumption."""
    theirs = net.res_bus.loc[buses.bus]
    shunts = net.res_shunt.groupby(net.shunt.bus)[["p_mw", "q_mvar"]].sum().reindex(buses.bus, fill_value=0.0)
    np.testing.assert_allclose(-buses.p_kw / 1e3, theirs.p_mw - shunts.p_mw, rtol=0, atol=1e-6)
    np.testing.assert_allclose(-buses.q_kvar / 1e3, theirs.q_mvar - shunts.q_mvar, rtol=0, atol=1e-6)
    np.testing.assert_allclose(buses.vm_kv, theirs.vm_pu * net.bus.vn_kv.loc[buses.bus], rtol=0, atol=1e-6)
    angle = (buses.va_deg - theirs.va_degree.to_numpy() + 180) % 360 - 180
    np.testing.assert_allclose(angle, 0.0, rtol=0, atol=1e-6)
