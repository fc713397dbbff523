"""Where a file has measurements, a load's meter says what it draws; its law of voltage must not count again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from scenarios.importers import Imported, import_grid
from tests.support.pandapower_tables import ONE_WORKER, LoadedLate

pp: Any = LoadedLate("pandapower")
pgm: Any = pytest.importorskip("power_grid_model")
utils: Any = pytest.importorskip("power_grid_model.utils")

pytestmark = [
    ONE_WORKER,
    pytest.mark.filterwarnings("ignore::Warning:pandapower", "ignore::Warning:pandas"),
    pytest.mark.slow,
]

LOAD, SOURCE = 4, 2
CONSTANT_POWER, CONSTANT_IMPEDANCE, CONSTANT_CURRENT = 0, 1, 2


def estimated_vm(grid: Imported) -> np.ndarray:
    """From readings and exact zero injections, in the order of the buses."""
    zero = grid.zero_injection if isinstance(grid.zero_injection, tuple) else ()
    kinds = (MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION)
    virtual = [Measurement(Meter(k, bus, source=Source.VIRTUAL), 0.0, 0.0) for bus in zero for k in kinds]
    return estimate_state(grid.network, [*grid.readings, *virtual], tolerance=1e-10).vm


# pandapower


def with_exact_measurements(net: Any) -> Any:
    pp.runpp(net, numba=False, tolerance_mva=1e-10)
    for bus in net.bus.index:
        for kind, sigma in (("vm_pu", 0.002), ("p_mw", 0.02), ("q_mvar", 0.02)):
            pp.create_measurement(net, kind[0], "bus", net.res_bus.at[bus, kind], sigma, bus)
    return net


def pandapower_feeder(ends: Sequence[tuple[int, int]], loads: Sequence[tuple[int, float, float, float, float]]) -> Any:
    net = pp.create_empty_network(sn_mva=10)
    for _ in range(len(ends) + 1):
        pp.create_bus(net, 20.0)
    pp.create_ext_grid(net, 0)
    for a, b in ends:
        pp.create_line_from_parameters(net, a, b, 10 / len(ends), 0.3, 0.3, 0, 1)
    for bus, p, q, z_percent, i_percent in loads:
        shares = {f"const_{k}_{part}_percent": v for k, v in (("z", z_percent), ("i", i_percent)) for part in "pq"}
        pp.create_load(net, bus, p, q, **shares)
    return net


def imported_from_pandapower(tmp_path: Path, net: Any) -> Imported:
    pp.to_json(net, str(tmp_path / "net.json"))
    return import_grid(tmp_path / "net.json")


def test_a_measured_constant_impedance_is_not_counted_twice(tmp_path: Path) -> None:
    net = with_exact_measurements(pandapower_feeder([(0, 1)], [(1, 4.0, 1.0, 100.0, 0.0)]))
    grid = imported_from_pandapower(tmp_path, net)
    assert net.res_bus.vm_pu[1] == pytest.approx(0.96363, abs=1e-5)
    np.testing.assert_allclose(estimated_vm(grid), net.res_bus.vm_pu, rtol=0, atol=1e-8)


@pytest.mark.random_cases(few=3, long=12, many=12)
def test_no_random_pandapower_network_has_another_estimate_than_its_exact_readings(
    tmp_path: Path, random_seed: int
) -> None:
    rng = np.random.default_rng(random_seed)
    n_bus = int(rng.integers(4, 15))
    ends = [(int(rng.integers(0, bus)), bus) for bus in range(1, n_bus)]
    shares = rng.choice([0.0, 30.0, 50.0], size=(n_bus, 2))
    loads = [(b, *rng.uniform(0.1, 4 / n_bus, 2), *shares[b]) for b in range(1, n_bus) for _ in range(2)]
    net = with_exact_measurements(pandapower_feeder(ends, loads))
    grid = imported_from_pandapower(tmp_path, net)
    np.testing.assert_allclose(estimated_vm(grid), net.res_bus.vm_pu, rtol=0, atol=1e-8)


def test_a_constant_current_is_rejected_where_nothing_measures_it(tmp_path: Path) -> None:
    net = pandapower_feeder([(0, 1)], [(1, 4.0, 1.0, 0.0, 10.0)])
    with pytest.raises(InvalidInputError, match="load 0: const_i_p_percent is not 0"):
        imported_from_pandapower(tmp_path, net)


# power-grid-model


def power_grid_model_feeder(seed: int, types: Sequence[int]) -> dict[str, Any]:
    """A random radial grid with two loads of random types at each node, without sensors."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 15))

    def table(component: str, **columns: Any) -> Any:
        made = pgm.initialize_array("input", component, len(next(iter(columns.values()))))
        for name, values in columns.items():
            made[name] = values
        return made

    ones = [1] * (n - 1)
    return {
        "node": table("node", id=range(n), u_rated=[20e3] * n),
        "line": table(
            "line", id=range(100, 99 + n), from_node=[rng.integers(0, b) for b in range(1, n)], to_node=range(1, n),
            from_status=ones, to_status=ones, r1=[3 / n] * (n - 1), x1=[3 / n] * (n - 1), c1=[1e-8] * (n - 1),
            tan1=[0.0] * (n - 1), i_n=[1e3] * (n - 1),
        ),
        "sym_load": table(
            "sym_load", id=range(200, 198 + 2 * n), node=[*range(1, n)] * 2, status=ones * 2,
            type=rng.choice(types, size=2 * n - 2), p_specified=rng.uniform(1e5, 4e6 / n, 2 * n - 2),
            q_specified=rng.uniform(1e5, 2e6 / n, 2 * n - 2),
        ),
        "source": table("source", id=[300], node=[0], status=[1], u_ref=[1.01], sk=[1e20]),
    }  # fmt: skip


def with_exact_sensors(data: dict[str, Any], output: dict[str, Any]) -> dict[str, Any]:
    """``data`` with a sensor of the power of each load and the source, and of the voltage of each node."""
    parts = [(output["sym_load"], LOAD), (output["source"], SOURCE)]
    n_power = sum(len(part) for part, _ in parts)
    power = pgm.initialize_array("input", "sym_power_sensor", n_power)
    power["id"], power["power_sigma"] = range(400, 400 + n_power), 2e4
    power["measured_object"] = np.concatenate([part["id"] for part, _ in parts])
    power["measured_terminal_type"] = np.concatenate([[terminal] * len(part) for part, terminal in parts])
    power["p_measured"] = np.concatenate([part["p"] for part, _ in parts])
    power["q_measured"] = np.concatenate([part["q"] for part, _ in parts])
    voltage = pgm.initialize_array("input", "sym_voltage_sensor", len(output["node"]))
    voltage["id"], voltage["u_sigma"] = range(500, 500 + len(output["node"])), 40.0
    voltage["measured_object"], voltage["u_measured"] = output["node"]["id"], output["node"]["u"]
    return data | {"sym_power_sensor": power, "sym_voltage_sensor": voltage}


def imported_from_power_grid_model(tmp_path: Path, data: dict[str, Any]) -> Imported:
    utils.json_serialize_to_file(tmp_path / "grid.json", data)
    return import_grid(tmp_path / "grid.json")


@pytest.mark.parametrize("seed", range(6))
def test_no_random_power_grid_model_network_has_another_estimate_than_its_exact_readings(
    tmp_path: Path, seed: int
) -> None:
    data = power_grid_model_feeder(seed, (CONSTANT_POWER, CONSTANT_IMPEDANCE, CONSTANT_CURRENT))
    output = pgm.PowerGridModel(data).calculate_power_flow(error_tolerance=1e-12)
    grid = imported_from_power_grid_model(tmp_path, with_exact_sensors(data, output))
    rows = [grid.network.row[int(node)] for node in output["node"]["id"]]
    np.testing.assert_allclose(estimated_vm(grid)[rows], output["node"]["u_pu"], rtol=0, atol=1e-8)


def test_sensors_that_say_nothing_leave_the_loads_their_law_of_voltage(tmp_path: Path) -> None:
    data = power_grid_model_feeder(1, (CONSTANT_IMPEDANCE,))
    output = pgm.PowerGridModel(data).calculate_power_flow()
    data = with_exact_sensors(data, output)
    data["sym_power_sensor"] = data["sym_power_sensor"][:1]  # the other load at this node has none
    del data["sym_voltage_sensor"]
    grid = imported_from_power_grid_model(tmp_path, data)
    assert not grid.readings
    assert all(bus.g_shunt > 0 and bus.p_load == 0 for bus in grid.network.buses[1:])
    data["sym_load"]["type"][0] = CONSTANT_CURRENT
    with pytest.raises(InvalidInputError, match="sym_load 200: constant current"):
        imported_from_power_grid_model(tmp_path, data)
