"""What perfect meters read in a solved network, and how large that is: all places at once, then a look-up per meter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.power_flow.newton_raphson import PowerFlowResult

KIND = MeasurementKind
PLACES = tuple(KIND)


def read_exactly(power_flow: PowerFlowResult, meters: Sequence[Meter]) -> tuple[np.ndarray, np.ndarray]:
    """What each of ``meters``, which fit the network, would read without error, and its size: shape (n_meas,) each.

    P.u. and rad; the size of a power is the apparent power at its place, of all else the absolute value.
    """
    v = power_flow.vm * np.exp(1j * power_flow.va)
    stacked = power_flow.admittance.stacked
    u, i = v[_find_bus_rows(power_flow)], stacked @ v
    place = _find_places(power_flow, meters)
    code = {id(kind): k for k, kind in enumerate(PLACES)}  # members are singletons, and hashing them takes long
    kind = np.array([code[id(meter.kind)] for meter in meters], dtype=np.intp)
    s = (u * i.conj())[place]
    exact = np.zeros(len(meters))
    for k, name in enumerate(PLACES):
        here = kind == k
        if name in (KIND.VM, KIND.CURRENT):
            exact[here] = abs((u if name is KIND.VM else i)[place[here]])
        elif name is KIND.VA:
            exact[here] = np.angle(u[place[here]])
        else:
            exact[here] = s[here].real if name in (KIND.P_INJECTION, KIND.P_FLOW) else s[here].imag
    is_power = np.array([name not in (KIND.VM, KIND.VA, KIND.CURRENT) for name in PLACES])[kind]
    return exact, np.where(is_power, np.hypot(s.real, s.imag), abs(exact))


def _find_bus_rows(power_flow: PowerFlowResult) -> np.ndarray:
    """Of each row of the stacked admittances the row of its bus: buses, from ends, to ends of branches in service."""
    row, branches = power_flow.network.row, power_flow.network.active_branches
    at_from = [row[branch.from_bus] for branch in branches]
    return np.array([*range(len(row)), *at_from, *(row[branch.to_bus] for branch in branches)], dtype=np.intp)


def _find_places(power_flow: PowerFlowResult, meters: Sequence[Meter]) -> np.ndarray:
    """The row of the stacked admittances that each meter stands at, shape (n_meas,)."""
    row, branches = power_flow.network.row, power_flow.network.active_branches
    at = {branch.id: (branch.from_bus, len(row) + k) for k, branch in enumerate(branches)}
    beyond = len(branches)  # from a from end to the to end
    place = []
    for meter in meters:
        if meter.branch is None:
            place.append(row[meter.bus])
        else:
            from_bus, end = at[meter.branch]
            place.append(end if meter.bus == from_bus else end + beyond)
    return np.array(place, dtype=np.intp)
