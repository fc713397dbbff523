"""Grids of power-grid-model, with and without sensors, and what is imported of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.importers import Imported, import_grid

pgm: Any = pytest.importorskip("power_grid_model")
utils: Any = pytest.importorskip("power_grid_model.utils")
Data = dict[str, Any]
NODES = [1, 2, 3, 4, 5, 6, 7, 8, 9]
NAN = float("nan")
BRANCH_FROM, BRANCH_TO, SOURCE, SHUNT, LOAD, GENERATOR, NODE = 0, 1, 2, 3, 4, 5, 9


def table(component: str, **columns: list[Any]) -> Any:
    made = pgm.initialize_array("input", component, len(next(iter(columns.values()))))
    for name, values in columns.items():
        made[name] = values
    return made


def small_grid() -> Data:
    """150 / 10 / 0.4 kV: tap changers on either side, clocks, dielectric losses, a half-open line, a link 4 to 9."""
    both = {"from_status": [1, 1], "to_status": [1, 1]}
    kv = [150e3, 10e3, 10e3, 10e3, 10e3, 400.0, 10e3, 10e3, 10e3]
    return {
        "node": table("node", id=NODES, u_rated=kv),
        "transformer": table(
            "transformer", id=[20, 21], from_node=[1, 5], to_node=[2, 6], **both, u1=[150e3, 10.5e3], u2=[10.5e3, 420],
            sn=[30e6, 0.63e6], uk=[0.2, 0.04], pk=[100e3, 6e3], i0=[0.002, 0.003], p0=[20e3, 900], winding_from=[2, 2],
            winding_to=[1, 1], clock=[11, 5], tap_side=[0, 1], tap_pos=[4, -1], tap_min=[-11, 2], tap_max=[9, -2],
            tap_nom=[0, 0], tap_size=[2.5e3, 10], uk_min=[0.21, NAN], uk_max=[0.19, NAN], pk_min=[110e3, NAN],
            pk_max=[90e3, NAN],
        ),
        "line": table(
            "line", id=[30, 31, 32, 33, 34], from_node=[2, 3, 9, 4, 3], to_node=[3, 4, 5, 8, 5],
            from_status=[1, 1, 1, 1, 0], to_status=[1, 1, 1, 0, 0], r1=[0.3, 0.2, 0.25, 0.3, 0.1],
            x1=[0.2, 0.15, 0.1, 0.1, 0.1], c1=[3e-6, 1e-6, 2e-6, 5e-6, 0], tan1=[0.1, 0, 0.05, 0.02, 0], i_n=[300] * 5,
        ),
        "link": table("link", id=[38, 39], from_node=[9, 4], to_node=[4, 7], from_status=[1, 1], to_status=[1, 0]),
        "generic_branch": table(
            "generic_branch", id=[40], from_node=[3], to_node=[7], from_status=[1], to_status=[1], r1=[0.1], x1=[0.3],
            g1=[1e-4], b1=[2e-4], k=[1.02], theta=[0.05],
        ),
        "source": table(
            "source", id=[50], node=[1], status=[1], u_ref=[1.02], u_ref_angle=[0.1], sk=[2e9], rx_ratio=[0.2]
        ),
        "sym_load": table(
            "sym_load", id=[60, 61, 62, 63, 64], node=[4, 6, 7, 9, 3], status=[1, 1, 1, 1, 0], type=[0] * 5,
            p_specified=[1e6, 2e5, 3e5, 2e5, 9e6], q_specified=[2e5, 5e4, 1e5, 1e5, 0],
        ),
        "sym_gen": table("sym_gen", id=[70], node=[6], status=[1], type=[0], p_specified=[1e5], q_specified=[1e4]),
        "shunt": table("shunt", id=[80], node=[3], status=[1], g1=[1e-4], b1=[2e-3]),
    }  # fmt: skip


def imported(tmp_path: Path, data: Data, frequency_hz: float = 50.0) -> Imported:
    path = tmp_path / "grid.json"
    utils.json_serialize_to_file(path, data)
    return import_grid(path, frequency_hz=frequency_hz)


def problems_of(tmp_path: Path, data: Data) -> str:
    with pytest.raises(InvalidInputError) as caught:
        imported(tmp_path, data)
    assert "grid.json" in caught.value.what
    return "\n".join(caught.value.problems)


def voltages_there(grid: Imported, output: Data) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Our rows, their vm and va, of the nodes that are buses here."""
    known = [k for k, node in enumerate(output["node"]["id"]) if int(node) in grid.network.row]
    rows = np.array([grid.network.row[int(output["node"]["id"][k])] for k in known])
    return rows, output["node"]["u_pu"][known], output["node"]["u_angle"][known]


def check_power_flow(grid: Imported, data: Data, frequency_hz: float = 50.0) -> None:
    result = solve_power_flow(grid.network, tolerance=1e-12)
    model = pgm.PowerGridModel(data, system_frequency=frequency_hz)
    rows, vm, va = voltages_there(grid, model.calculate_power_flow(error_tolerance=1e-13, max_iterations=50))
    np.testing.assert_allclose(result.vm[rows], vm, rtol=0, atol=1e-8)
    np.testing.assert_allclose(np.exp(1j * result.va[rows]), np.exp(1j * va), rtol=0, atol=1e-8)


def without_link(data: Data) -> Data:
    """Links are nearly, not exactly, of no impedance there: 1e-8 needs a grid without."""
    data["line"]["from_node"][data["line"]["id"] == 32] = 4
    data["sym_load"]["node"][data["sym_load"]["id"] == 63] = 4
    data["link"]["from_status"] = 0
    data["link"]["to_status"] = 0
    return data


def measured_grid(*, stiff: bool = False) -> Data:
    """``small_grid`` without link, with sensors of every kind that can be a meter, with noise."""
    data = without_link(small_grid())
    if stiff:
        data["source"]["sk"] = 1e20
    output = pgm.PowerGridModel(data).calculate_power_flow(error_tolerance=1e-12)
    rng = np.random.default_rng(1)
    at = [2, 4, 4, 6, 1, 3, 5, 7]
    u = output["node"]["u"][[NODES.index(node) for node in at]]
    sigma = np.array([50, 20, 30, 2.0, 900, 40, 40, 40])
    data["sym_voltage_sensor"] = table(
        "sym_voltage_sensor", id=list(range(101, 109)), measured_object=at, u_sigma=sigma,
        u_measured=u + sigma * rng.standard_normal(8),
    )  # fmt: skip
    places = [
        (20, BRANCH_FROM),
        (21, BRANCH_TO),
        (30, BRANCH_FROM),
        (31, BRANCH_TO),
        (32, BRANCH_FROM),
        (40, BRANCH_TO),
    ]
    places += [(60, LOAD), (61, LOAD), (62, LOAD), (63, LOAD), (70, GENERATOR), (50, SOURCE), (30, BRANCH_FROM)]
    places += [(6, NODE)]
    powers = np.array([power_at(output, *place) for place in places])
    noisy = powers + 2e4 * rng.standard_normal(powers.shape)
    p_sigma = np.where(np.arange(len(places)) % 3 == 1, 3e4, NAN)
    data["sym_power_sensor"] = table(
        "sym_power_sensor", id=list(range(200, 200 + len(places))), measured_object=[place for place, _ in places],
        measured_terminal_type=[terminal for _, terminal in places], p_measured=noisy[:, 0], q_measured=noisy[:, 1],
        power_sigma=[2e4] * len(places), p_sigma=p_sigma, q_sigma=2 * p_sigma,
    )  # fmt: skip
    return data


def power_at(output: Data, component: int, terminal: int) -> tuple[float, float]:
    """(p, q) in W and var where a sensor of that terminal type looks."""
    suffix = {BRANCH_FROM: "_from", BRANCH_TO: "_to"}.get(terminal, "")
    for rows in output.values():
        if f"p{suffix}" in rows.dtype.names and component in rows["id"]:
            row = rows[rows["id"] == component][0]
            return float(row[f"p{suffix}"]), float(row[f"q{suffix}"])
    raise AssertionError(component)
