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
    """Start ``x`` of ``AreaModel``: the local power flow where the load messages allow one, else the unloaded area."""
    area = content.area
    vm, va = find_no_load(area)
    if area.network.table.nodes.is_balanced:  # with phases voltages depend little on loads, beside those of banks
        vm, va = _solve_with_loads(content, received, vm, va)
    return area.join_state(vm, va, [_find_power(area, power, received) for power in area.powers_into_children])


def _solve_with_loads(
    content: Configuration, received: Mapping[str, Loads], vm: np.ndarray, va: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The voltages of the local power flow, else ``vm`` and ``va``; angles count as those of the reference."""
    area, network = content.area, content.area.network
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
    return vm, va


def _find_power(area: Area, power: Variable, received: Mapping[str, Loads]) -> float:
    """The power into a child's branches by its load message; 0 without one."""
    if not (loads := received.get(power.area)):
        return 0.0
    alike = [variable for variable in area.boundaries[power.area].variables if variable.kind is power.kind]
    s = loads[alike.index(power) if len(loads) > 1 else 0].s
    return s.real if power.kind is Kind.P else s.imag
