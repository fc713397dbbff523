"""pandapower's WLS: ``estimate`` on a ready net, its only mode, so that cold and warm are the same."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.estimates.cases import Case
from benchmarks.methods.method import MAX_ITERATIONS, TOLERANCE, NotConvergedError, State
from benchmarks.methods.physical import describe_lines


@dataclass(frozen=True)
class PandapowerMethod:
    """On a base of 1 MVA, where its smallest sigma of 1e-5 p.u. (10 VA) is below all of ours."""

    name: str = "pandapower wls"
    package: str = "pandapower"

    def translate(self, case: Case) -> Any:
        import pandapower as pp

        lines = describe_lines(case.network)
        net = pp.create_empty_network(f_hz=50.0, sn_mva=1.0)
        pp.create_buses(net, len(lines.kv), lines.kv, index=range(len(lines.kv)))
        one = np.ones(len(lines.r_ohm))
        c_nf = lines.b_siemens / (2 * math.pi * net.f_hz) * 1e9
        ends = lines.from_row.tolist(), lines.to_row.tolist()
        pp.create_lines_from_parameters(net, *ends, one, lines.r_ohm, lines.x_ohm, c_nf, one, index=range(len(one)))
        pp.create_ext_grid(net, lines.slack_row, vm_pu=lines.slack_vm)
        net.measurement = _measurement_table(net.measurement, case)
        return net

    def build(self, data: Any) -> Any:
        return data

    def solve(self, model: Any) -> Any:
        from pandapower.estimation import estimate

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            answer = estimate(
                model, init="flat", tolerance=TOLERANCE, maximum_iterations=MAX_ITERATIONS, zero_injection=None
            )
        if not (answer["success"] if isinstance(answer, dict) else answer):
            raise NotConvergedError("it reports no success")
        return model

    def read(self, case: Case, result: Any) -> State:
        table = result.res_bus_est
        return State(table.vm_pu.to_numpy(), np.radians(table.va_degree.to_numpy()))


def _measurement_table(empty: Any, case: Case) -> Any:
    """All rows at once: ``create_measurement`` adds one at a time. Bus powers count consumption positive."""
    import pandas as pd

    mva = case.network.base_mva
    parts = [("v", "bus", case.vm, case.vm.value.real, case.vm.sigma)]
    for element, readings, sign in (("line", case.flow, 1), ("bus", case.injection, -1)):
        parts.append(("p", element, readings, sign * readings.value.real * mva, readings.sigma * mva))
        parts.append(("q", element, readings, sign * readings.value.imag * mva, readings.sigma * mva))
    frames = [
        pd.DataFrame(
            {
                "name": None,
                "measurement_type": kind,
                "element_type": element,
                "element": readings.row,
                "value": value,
                "std_dev": sigma,
                "side": "from" if element == "line" else None,
            }
        )
        for kind, element, readings, value, sigma in parts
    ]
    return pd.concat(frames, ignore_index=True)[list(empty.columns)].astype(empty.dtypes.to_dict())
