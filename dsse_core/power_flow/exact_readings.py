"""Readings of perfect meters in a solved network, and their sizes: all places at once, then a look-up per meter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.meter_table import KINDS, average, tabulate_meters
from dsse_core.power_flow.newton_raphson import PowerFlowResult

KIND = MeasurementKind


def read_exactly(power_flow: PowerFlowResult, meters: Sequence[Meter]) -> tuple[np.ndarray, np.ndarray]:
    """The readings of ``meters``, which fit the network, without error, and their sizes: shape (n_meas,) each.

    P.u. and rad. The size of a power is the apparent power at its place, of all other readings the absolute value.
    """
    network = power_flow.network
    v = power_flow.vm * np.exp(1j * power_flow.va)
    stacked = power_flow.admittance.stacked
    table, of_meter = tabulate_meters(network, meters).spread()
    kind, place = table.kind, np.where(table.branch < 0, table.node, len(v) + table.port)
    u, i = v[table.node], (stacked @ v)[place]
    if table.other is not None:
        u = u - np.where(table.other < 0, 0.0, v[table.other])
    s = u * i.conj()
    exact = np.zeros(len(u))
    for k, name in enumerate(KINDS):
        here = kind == k
        if name in (KIND.VM, KIND.CURRENT):
            exact[here] = abs((u if name is KIND.VM else i)[here])
        elif name is KIND.VA:
            exact[here] = np.angle(u[here])
        elif name.is_virtual:
            exact[here] = (i if name is KIND.I_REAL else -1j * i)[here].real
        else:
            exact[here] = s[here].real if name in (KIND.P_INJECTION, KIND.P_FLOW) else s[here].imag
    is_power = np.array([name.has_total and not name.is_virtual for name in KINDS])[kind]
    s, exact = average(np.where(is_power, s, exact), of_meter), average(exact, of_meter)
    return exact, np.hypot(s.real, s.imag)  # abs(s) differs by a bit
