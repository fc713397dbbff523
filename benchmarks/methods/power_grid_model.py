"""power-grid-model: Newton-Raphson, and iterative-linear, which minimises another objective."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.estimates.cases import Case
from benchmarks.methods.method import MAX_ITERATIONS, TOLERANCE, State
from benchmarks.methods.physical import LineNetwork, describe_lines

FREQUENCY_HZ = 50.0


@dataclass(frozen=True)
class PowerGridModelMethod:
    """Every bus but the substation's has a load: a bus without appliances would be an exact zero injection.

    Ids are rows of the whole input: buses, then lines, then the rest. The result is asked for at the nodes only.
    """

    name: str
    algorithm: str
    package: str = "power-grid-model"

    def translate(self, case: Case) -> dict[str, np.ndarray]:
        lines = describe_lines(case.network)
        tables = component_tables(lines)
        first_id = sum(map(len, tables.values()))
        tables["sym_voltage_sensor"] = _voltage_sensors(case, lines, first_id)
        tables["sym_power_sensor"] = _power_sensors(case, first_id + len(case.vm.row))
        return tables

    def build(self, data: dict[str, np.ndarray]) -> Any:
        import power_grid_model as pgm

        return pgm.PowerGridModel(data, system_frequency=FREQUENCY_HZ)

    def solve(self, model: Any) -> Any:
        import power_grid_model as pgm

        return model.calculate_state_estimation(
            symmetric=True,
            error_tolerance=TOLERANCE,
            max_iterations=MAX_ITERATIONS,
            calculation_method=pgm.CalculationMethod[self.algorithm],
            output_component_types=[pgm.ComponentType.node],
        )

    def read(self, case: Case, result: Any) -> State:
        assert case.network.slack is not None
        node = result["node"]
        return State(node["u_pu"], node["u_angle"] - node["u_angle"][case.network.row[case.network.slack.bus]])


def _table(component: str, n: int, **columns: Any) -> np.ndarray:
    import power_grid_model as pgm

    rows: np.ndarray = pgm.initialize_array("input", component, n)
    for name, column in columns.items():
        rows[name] = column
    return rows


def component_tables(lines: LineNetwork) -> dict[str, np.ndarray]:
    n, m = len(lines.kv), len(lines.r_ohm)
    loaded = np.delete(np.arange(n), lines.slack_row)
    return {
        "node": _table("node", n, id=np.arange(n), u_rated=1e3 * lines.kv),
        "line": _table(
            "line",
            m,
            id=n + np.arange(m),
            from_node=lines.from_row,
            to_node=lines.to_row,
            from_status=1,
            to_status=1,
            r1=lines.r_ohm,
            x1=lines.x_ohm,
            c1=lines.b_siemens / (2 * math.pi * FREQUENCY_HZ),
            tan1=0.0,
        ),
        "sym_load": _table(
            "sym_load", n - 1, id=n + m + np.arange(n - 1), node=loaded, status=1, type=0, p_specified=0, q_specified=0
        ),
        "source": _table("source", 1, id=2 * n + m - 1, node=lines.slack_row, status=1, u_ref=lines.slack_vm),
    }


def _voltage_sensors(case: Case, lines: LineNetwork, first_id: int) -> np.ndarray:
    volt = 1e3 * lines.kv[case.vm.row]
    return _table(
        "sym_voltage_sensor",
        len(volt),
        id=first_id + np.arange(len(volt)),
        measured_object=case.vm.row,
        u_measured=case.vm.value.real * volt,
        u_sigma=case.vm.sigma * volt,
    )


def _power_sensors(case: Case, first_id: int) -> np.ndarray:
    """Power sensors; Newton-Raphson reads p_sigma and q_sigma, iterative-linear power_sigma."""
    from power_grid_model import MeasuredTerminalType as Terminal

    va = case.network.base_mva * 1e6
    value = np.r_[case.flow.value, case.injection.value] * va
    sigma = np.r_[case.flow.sigma, case.injection.sigma] * va
    n_flow, n_injection = len(case.flow.row), len(case.injection.row)
    return _table(
        "sym_power_sensor",
        len(value),
        id=first_id + np.arange(len(value)),
        measured_object=np.r_[len(case.network.buses) + case.flow.row, case.injection.row],
        measured_terminal_type=np.repeat([Terminal.branch_from, Terminal.node], [n_flow, n_injection]),
        p_measured=value.real,
        q_measured=value.imag,
        p_sigma=sigma,
        q_sigma=sigma,
        power_sigma=math.sqrt(2) * sigma,
    )
