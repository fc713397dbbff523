"""pandapower networks with asymmetric tables: the power flow is that of runpp_3ph, and what it lacks is rejected."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.importers import import_grid
from scenarios.importers.imported_files import write_imported
from scenarios.scenario import load_scenario
from tests.support.levels import further
from tests.support.pandapower_tables import ONE_WORKER, LoadedLate

pp: Any = LoadedLate("pandapower")

pytestmark = [
    ONE_WORKER,
    pytest.mark.filterwarnings("ignore::Warning:pandapower", "ignore::Warning:pandas"),
    pytest.mark.slow,
]
LINE = {"length_km": 0.5, "r_ohm_per_km": 0.4, "x_ohm_per_km": 0.3, "c_nf_per_km": 200, "max_i_ka": 0.3}
LINE |= {"r0_ohm_per_km": 0.8, "x0_ohm_per_km": 1.0, "c0_nf_per_km": 100}
UNIT = {
    "sn_mva": 0.4,
    "vn_hv_kv": 10,
    "vn_lv_kv": 0.4,
    "vk_percent": 4.5,
    "vkr_percent": 1.2,
    "pfe_kw": 1,
    "i0_percent": 0.3,
}
UNIT |= {"vk0_percent": 4.2, "vkr0_percent": 1.1, "mag0_percent": 100, "mag0_rx": 0.1, "si0_hv_partial": 0.9}
TOLERANCE = 2e-7  # p.u.; runpp_3ph ends at a mismatch of 3e-8 MVA, here of a base of 1 MVA and weaker than that


def feeder(vector_group: str = "Dyn") -> Any:
    """Two buses of 10 kV, a transformer, and a branched feeder of 0.4 kV with loads of both connections."""
    net = pp.create_empty_network(sn_mva=1.0, name="feeder")
    b = [pp.create_bus(net, 10.0 if k < 2 else 0.4, name=f"b{k}") for k in range(7)]
    source = {"s_sc_max_mva": 500, "rx_max": 0.1, "r0x0_max": 0.2, "x0x_max": 1.5}
    pp.create_ext_grid(net, b[0], vm_pu=1.02, va_degree=5.0, **source)
    pp.create_line_from_parameters(net, b[0], b[1], **LINE)
    shift = 0 if vector_group == "YNyn" else 150
    pp.create_transformer_from_parameters(net, b[1], b[2], **UNIT, shift_degree=shift, vector_group=vector_group)
    for one, other in ((2, 3), (3, 4), (3, 5), (5, 6)):
        pp.create_line_from_parameters(net, b[one], b[other], **LINE | {"length_km": 0.15})
    pp.create_load(net, b[4], p_mw=0.02, q_mvar=0.005)
    pp.create_load(net, b[5], p_mw=0.01, q_mvar=0.005, type="delta")
    pp.create_sgen(net, b[4], p_mw=0.005, type="wye")
    for bus in (0, 1, 3):
        power = {"p_a_mw": 0.03, "p_b_mw": 0.01, "p_c_mw": 0.02, "q_a_mvar": 0.01, "q_c_mvar": 0.005}
        pp.create_asymmetric_load(net, b[bus], **power, scaling=0.9)
    pp.create_asymmetric_load(net, b[5], p_a_mw=0.012, p_c_mw=0.004, q_a_mvar=0.003, type="delta")
    pp.create_asymmetric_sgen(net, b[4], p_a_mw=0.01, q_a_mvar=0.002, p_c_mw=0.003)
    pp.create_shunt(net, b[2], q_mvar=-0.02)
    pp.create_switch(net, b[5], 4, et="l", closed=False)
    pp.create_switch(net, b[6], b[5], et="b", closed=True)
    return net


def read(tmp_path: Path, net: Any) -> Any:
    pp.to_json(net, str(tmp_path / "net.json"))
    return import_grid(tmp_path / "net.json")


@pytest.mark.parametrize("vector_group", ["Dyn", *further("YNyn", "Yzn")])
def test_the_power_flow_is_that_of_pandapower_and_areas_are_estimated(tmp_path: Path, vector_group: str) -> None:
    net = feeder(vector_group)
    pp.runpp_3ph(net, numba=False)
    imported = read(tmp_path, net)
    network, found = imported.network, solve_power_flow(imported.network, tolerance=1e-12)
    mine = dict(zip(network.nodes, found.vm * np.exp(1j * found.va), strict=True))
    for bus, of in net.res_bus_3ph.iterrows():
        for phase in "abc" if bus != 6 else "":
            theirs = of[f"vm_{phase}_pu"] * np.exp(1j * np.radians(of[f"va_{phase}_degree"]))
            assert abs(mine[bus, phase] - theirs) < TOLERANCE
    path, _ = write_imported(tmp_path / "out", imported, 2)
    assert len(load_scenario(path).partition.areas) == 2


@pytest.mark.parametrize(
    "case",
    [
        (lambda net: pp.create_gen(net, 4, p_mw=0.01), "gen 0: beside asymmetric loads"),
        *further(
            (lambda net: net.load.__setitem__("type", "Y"), "load 0, 1: type is neither"),
            (lambda net: net.trafo.__setitem__("vector_group", "Yd"), "pandapower finds no three-phase power flow"),
            (lambda net: net.asymmetric_load.__setitem__("p_a_mw", np.nan), "p_a_mw is nan"),
        ),
    ],
)
def test_what_its_power_flow_lacks_is_rejected_by_name(tmp_path: Path, case: tuple[Callable[[Any], Any], str]) -> None:
    change, problem = case
    change(net := feeder())
    with pytest.raises(InvalidInputError) as caught:
        read(tmp_path, net)
    assert problem in str(caught.value)
