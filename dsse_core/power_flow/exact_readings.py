"""Readings of perfect meters in a solved network, and their sizes: all places at once, then a look-up per meter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import OF_POWER, QUANTITY, average, tabulate_meters
from dsse_core.grid.quantities import Phasors, QuantityRows
from dsse_core.power_flow.newton_raphson import PowerFlowResult


def read_exactly(power_flow: PowerFlowResult, meters: Sequence[Meter]) -> tuple[np.ndarray, np.ndarray]:
    """The readings of ``meters``, which fit the network, without error, and their sizes: shape (n_meas,) each.

    P.u. and rad. The size of a power is the apparent power at its place, of all other readings the absolute value.
    """
    network = power_flow.network
    v = power_flow.vm * np.exp(1j * power_flow.va)
    stacked = power_flow.admittance.stacked
    table, of_meter = tabulate_meters(network, meters).spread()
    place = np.where(table.branch < 0, table.node, len(v) + table.port)
    u, i = v[table.node], (stacked @ v)[place]
    if table.other is not None:
        u = u - np.where(table.other < 0, 0.0, v[table.other])
    phasors = Phasors(u, i)
    exact = QuantityRows(QUANTITY[table.kind]).read(phasors)
    s, exact = average(np.where(OF_POWER[table.kind], phasors.s, exact), of_meter), average(exact, of_meter)
    return exact, np.hypot(s.real, s.imag)  # abs(s) differs by a bit
