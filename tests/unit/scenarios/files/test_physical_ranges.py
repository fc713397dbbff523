"""No network with numbers that no grid has gets in, whatever file it comes from."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dsse_core.errors import InvalidInputError
from scenarios.files.network_file import load_network
from scenarios.files.shipped_files import find_shipped
from scenarios.importers import import_grid
from tests.support.pandapower_tables import ONE_WORKER

CASE = """function mpc = feeder
mpc.version = '2';
mpc.baseMVA = 10;
mpc.bus = [
  1 3 0   0    0 0 1 1 0 20 1 1.1 0.9
  2 1 LOAD 0.3  0 0 1 1 0 20 1 1.1 0.9
];
mpc.gen = [ 1 0 0 9 -9 1.02 100 1 9 0 ];
mpc.branch = [ 1 2 0.01 0.02 0 0 0 0 0 0 1 ];
"""
RANGE = "it must lie between -1e+06 and 1e+06 MW; correct it"


def problems_of(read: Callable[[Path], object], path: Path) -> list[str]:
    with pytest.raises(InvalidInputError) as caught:
        read(path)
    assert path.name in caught.value.what
    return list(caught.value.problems)


@pytest.mark.parametrize("load", ["1e308", "-1e7", "1000001"])
def test_a_matpower_case_is_rejected_with_the_bus_the_value_and_the_range(tmp_path: Path, load: str) -> None:
    path = tmp_path / "case.m"
    path.write_text(CASE.replace("LOAD", load))
    (problem,) = problems_of(import_grid, path)
    assert problem == f"bus 2: active load is {float(load):g} MW; {RANGE}"


@pytest.mark.slow
@ONE_WORKER
def test_a_pandapower_network_is_rejected_alike(tmp_path: Path) -> None:
    pandapower: Any = pytest.importorskip("pandapower")
    net = pandapower.create_empty_network()
    one, two = (pandapower.create_bus(net, 20) for _ in range(2))
    pandapower.create_ext_grid(net, one)
    pandapower.create_line(net, one, two, 1, "NA2XS2Y 1x185 RM/25 12/20 kV")
    pandapower.create_load(net, two, 1e308)
    pandapower.to_json(net, str(tmp_path / "net.json"))
    assert problems_of(import_grid, tmp_path / "net.json") == [f"bus 1: active load is 1e+308 MW; {RANGE}"]


@pytest.mark.parametrize(
    ("component", "attribute", "value", "expected"),
    [
        ("sym_load", "p_specified", 1e308, f"bus 2: active load is 1e+302 MW; {RANGE}"),
        ("node", "u_rated", 1e200, "bus 1: base voltage is 1e+197 kV; it must lie between 0.001 and 10000 kV"),
        ("line", "r1", 1e200, "branch 1-2: r is 1e+198 p.u.; it must lie between -1e+09 and 1e+09 p.u."),
        ("line", "c1", 1e200, "branch 1-2: b is"),
        ("source", "u_ref", 1e200, "source at bus 3: voltage is 1e+200 p.u.; it must lie between 0.1 and 10 p.u."),
        ("source", "sk", 1e-300, "branch 3-1: r is"),
        ("transformer", "u2", 1e200, "it has numbers that cannot be computed with (OverflowError)"),
    ],
)
def test_power_grid_model_data_are_rejected_alike(
    tmp_path: Path, component: str, attribute: str, value: float, expected: str
) -> None:
    pytest.importorskip("power_grid_model")
    data: dict[str, list[dict[str, float]]] = {
        "node": [{"id": 1, "u_rated": 1e4}, {"id": 2, "u_rated": 1e4}],
        "line": [{"id": 3, "from_node": 1, "to_node": 2, "from_status": 1, "to_status": 1}],
        "source": [{"id": 4, "node": 1, "status": 1, "u_ref": 1.0}],
        "sym_load": [{"id": 5, "node": 2, "status": 1, "type": 0, "p_specified": 1e5, "q_specified": 1e4}],
    }
    transformer = {"id": 6, "from_node": 1, "to_node": 2, "from_status": 1, "to_status": 1, "u1": 1e4, "u2": 1e4}
    transformer |= {"sn": 1e6, "uk": 0.1, "pk": 1e3, "i0": 0.01, "p0": 100.0, "winding_from": 1, "winding_to": 1}
    transformer |= {"clock": 0, "tap_side": 0, "tap_pos": 0, "tap_min": 0, "tap_max": 0, "tap_size": 0.0}
    data["transformer"] = [transformer]
    data["line"][0] |= {"r1": 0.1, "x1": 0.1, "c1": 1e-6, "tan1": 0.0, "i_n": 100.0}
    data[component][0][attribute] = value
    tree = {"version": "1.0", "type": "input", "is_batch": False, "attributes": {}, "data": data}
    (tmp_path / "grid.json").write_text(json.dumps(tree))
    assert expected in "\n".join(problems_of(import_grid, tmp_path / "grid.json"))


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("p_load_mw = 0.1,", "p_load_mw = 1e308,", f"bus 2: active load is 1e+308 MW; {RANGE}"),
        ("base_kv = 12.66", "base_kv = 1e-200", "bus 1: base voltage is 1e-200 kV; it must lie between 0.001"),
        ("base_mva = ", "base_mva = 1e300 #", "base_mva is 1e+300 MVA; it must lie between 1e-06 and 1e+06 MVA"),
        ("r_ohm = 0.0922", "r_ohm = 1e300", "branch 1-2: r is"),
        ("= 33", "= 9" + 400 * "9", "bus 99999999999999999999...: a number of a bus lies within 1e+15 of 0"),
    ],
)
def test_a_network_file_is_rejected_alike(tmp_path: Path, old: str, new: str, expected: str) -> None:
    text = find_shipped("cases")["ieee33"].read_text()
    assert old in text
    path = tmp_path / "network.toml"
    path.write_text(text.replace(old, new, -1 if old == "= 33" else 1))
    assert expected in "\n".join(problems_of(load_network, path))


@pytest.mark.parametrize("name", sorted(find_shipped("cases")))
def test_what_is_shipped_is_within(name: str) -> None:
    load_network(find_shipped("cases")[name])
