"""Start of the iterations of ``admm``, which has no influence on their end; voltages of the unloaded area."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agents.protocol.configuration import Configuration
from dsse_core.errors import DsseError
from dsse_core.exchange.boundary_load import NetLoad, boundary_loads
from dsse_core.grid.admittance import flat_start
from dsse_core.grid.boundary import Kind
from dsse_core.grid.partition import Area
from dsse_core.power_flow.newton_raphson import solve_power_flow


def find_no_load(area: Area) -> tuple[np.ndarray, np.ndarray]:
    """The voltages (vm, va) of the unloaded area; angles count from its reference bus, or else its local slack bus."""
    return flat_start(area.network, area.reference[0] if area.reference else area.slack_bus)


def start_state(content: Configuration, received: Mapping[str, NetLoad]) -> np.ndarray:
    """Start ``x`` of ``AreaModel``: the local power flow where the load messages allow one, else the unloaded area."""
    area, network = content.area, content.area.network
    vm, va = find_no_load(area)
    loads = boundary_loads(area, received, content.load_error)
    if len(loads) == len(area.boundary_buses) and area.slack_vm is not None:
        try:
            beyond = {b: load.s for b, load in loads.items()}
            flow = solve_power_flow(network, slack=(area.slack_bus, area.slack_vm), extra_load=beyond)
            vm, va = flow.vm, flow.va
        except DsseError:
            pass  # only a start: a wrong load message must not stop the estimate
    if area.reference:
        bus, angle = area.reference
        va = va + angle - va[network.row[bus]]
    nothing = NetLoad(0j)
    into_children = [(power.kind, received.get(power.area, nothing).s) for power in area.powers_into_children]
    powers = [s.real if kind is Kind.P else s.imag for kind, s in into_children]
    return np.concatenate([va, vm, powers])
