"""gridstate's WLS without robust weights: ``estimate`` on a ready model, so that cold and warm are the same."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.estimates.cases import Case
from benchmarks.methods.method import MAX_ITERATIONS, TOLERANCE, NotConvergedError, State
from benchmarks.methods.physical import describe_lines


@dataclass(frozen=True)
class GridstateMethod:
    """Its base is 100 MVA and its smallest sigma 1e-5 p.u., 1 kVA. So 1 MVA is given to it as 100 MVA, and each
    impedance as a hundredth: the same network in p.u. of 1 MVA.
    """

    name: str = "gridstate wls"
    package: str = "gridstate"

    def translate(self, case: Case) -> dict[str, np.ndarray]:
        from gridstate.constants import NodeType
        from gridstate.contract.tables import SE_INPUT, SE_OUTPUT, io_dtype
        from gridstate.units import BASE_MVA

        lines = describe_lines(case.network)
        nodes = np.zeros(len(lines.kv), io_dtype(SE_INPUT.nodes, SE_OUTPUT.nodes))
        nodes["id"], nodes["status"] = np.arange(1, len(nodes) + 1), True
        nodes["voltage_nominal"] = nodes["voltage_magnitude"] = lines.kv
        nodes["node_type"][lines.slack_row] = NodeType.SLACK
        branches = np.zeros(len(lines.r_ohm), io_dtype(SE_INPUT.branches, SE_OUTPUT.branches))
        branches["id"], branches["status"] = np.arange(1, len(branches) + 1), True
        branches["from_node"], branches["to_node"] = lines.from_row + 1, lines.to_row + 1
        branches["resistance"], branches["reactance"] = lines.r_ohm / BASE_MVA, lines.x_ohm / BASE_MVA
        branches["susceptance_from"] = branches["susceptance_to"] = lines.b_siemens * BASE_MVA / 2
        branches["tap_ratio"] = 1.0
        measurements = _measurement_table(case, lines.kv, case.network.base_mva * BASE_MVA)
        return {"nodes": nodes, "branches": branches, "measurements": measurements}

    def build(self, data: dict[str, np.ndarray]) -> Any:
        from gridstate.contract.tables import SE_INPUT
        from gridstate.working import Working

        return Working.from_arrays(**data, generators=np.zeros(0, SE_INPUT.generators.input_dtype()))

    def solve(self, model: Any) -> Any:
        from gridstate import estimate

        result = estimate(
            model,
            algorithm="wls",
            init="flat",
            tolerance=TOLERANCE,
            max_iterations=MAX_ITERATIONS,
            huber_c=0.0,
            reconcile_balance=False,
            include_quality_summary=False,
        )
        if not result.success:
            raise NotConvergedError(f"solve status {result.convergence_status}")
        return result

    def read(self, case: Case, result: Any) -> State:
        return State(np.asarray(result.v_pu), np.asarray(result.delta_rad), int(result.iterations))


def _measurement_table(case: Case, kv: np.ndarray, mva: float) -> np.ndarray:
    from gridstate.constants import MeasurementObjectType as Place
    from gridstate.constants import MeasurementType as Kind
    from gridstate.contract.tables import SE_INPUT, SE_OUTPUT, io_dtype

    parts = [(Kind.VOLTAGE, Place.NODE, case.vm, case.vm.value.real * kv[case.vm.row], case.vm.sigma * kv[case.vm.row])]
    for place, readings, kinds in (
        (Place.BRANCH, case.flow, (Kind.POWER_P, Kind.POWER_Q)),
        (Place.NODE, case.injection, (Kind.POWER_INJECTION_P, Kind.POWER_INJECTION_Q)),
    ):
        parts.append((kinds[0], place, readings, readings.value.real * mva, readings.sigma * mva))
        parts.append((kinds[1], place, readings, readings.value.imag * mva, readings.sigma * mva))
    tables = []
    for kind, place, readings, value, sigma in parts:
        rows = np.zeros(len(readings.row), io_dtype(SE_INPUT.measurements, SE_OUTPUT.measurements))
        rows["object_type"], rows["measurement_type"], rows["object_id"] = place, kind, readings.row + 1
        rows["value"], rows["variance"], rows["status"] = value, sigma**2, True
        rows["branch_side"] = 0 if place is Place.BRANCH else -1
        tables.append(rows)
    table = np.concatenate(tables)
    table["id"] = np.arange(1, len(table) + 1)
    return table
