"""Start of the iterations of ``admm``, which has no influence on their end; voltages of the unloaded area."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agents.protocol.configuration import Configuration
from dsse_core.errors import DsseError
from dsse_core.exchange.boundary_load import Loads, boundary_loads
from dsse_core.grid.admittance import flat_start
from dsse_core.grid.boundary import Kind, Variable
from dsse_core.grid.partition import Area
from dsse_core.power_flow.newton_raphson import solve_power_flow


def find_no_load(area: Area) -> tuple[np.ndarray, np.ndarray]:
    """The voltages (vm, va) of the unloaded area; angles count from its reference bus, or else its local slack bus.

    With phases those of the unloaded grid.
    """
    if not area.network.table.nodes.is_balanced:
        return area.find_no_load()
    return flat_start(area.network, area.reference[0] if area.reference else area.slack_bus)


def start_state(content: Configuration, received: Mapping[str, Loads]) -> np.ndarray:
    """Start ``x`` of ``AreaModel``: the local power flow where the load messages allow one, else the unloaded area.

    Areas with phases start unloaded: their voltages depend little on loads, beside those of banks.
    """
    area, network = content.area, content.area.network
    vm, va = find_no_load(area)
    is_balanced = network.table.nodes.is_balanced
    loads = boundary_loads(area, received, content.load_error) if is_balanced else {}
    if len(loads) == len(area.boundary_buses) and area.slack_vm is not None and is_balanced:
        try:
            beyond = {b: load.s for b, load in loads.items()}
            flow = solve_power_flow(network, slack=(area.slack_bus, area.slack_vm), extra_load=beyond)
            vm, va = flow.vm, flow.va
        except DsseError:
            pass  # only a start: a wrong load message must not stop the estimate
    if area.reference and is_balanced:
        bus, angle = area.reference
        va = va + angle - va[network.row[bus]]
    return np.concatenate([va, vm, [_find_power(area, power, received) for power in area.powers_into_children]])


def _find_power(area: Area, power: Variable, received: Mapping[str, Loads]) -> float:
    """The power into a child's branches by its load message; 0 without one."""
    if not (loads := received.get(power.area)):
        return 0.0
    alike = [variable for variable in area.boundaries[power.area].variables if variable.kind is power.kind]
    s = loads[alike.index(power) if len(loads) > 1 else 0].s
    return s.real if power.kind is Kind.P else s.imag
