"""Newton-Raphson power flow: the voltages at which every bus meets its scheduled injection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse.linalg as spla

from dsse_core.admittance import Admittance, build_admittance, flat_start
from dsse_core.errors import InvalidInputError, PowerFlowDivergedError
from dsse_core.measurement import MeasurementKind, Meter
from dsse_core.measurement_model import build_measurement_model
from dsse_core.network import Control, Network


@dataclass(frozen=True)
class PowerFlowResult:
    """The solved network. ``vm`` p.u., ``va`` rad, ``injection`` (complex, p.u.): shape (n_bus,), network order."""

    network: Network
    vm: np.ndarray
    va: np.ndarray
    injection: np.ndarray
    iterations: int

    @property
    def losses(self) -> complex:
        """Series and shunt losses, p.u.: everything that is injected and not taken out again."""
        return complex(self.injection.sum())

    def read(self, meter: Meter) -> float:
        """What a perfect meter would read, p.u. or rad."""
        model = build_measurement_model(self.network, self._admittance, [meter])
        return float(model.predict(np.r_[self.va, self.vm])[0])

    @cached_property
    def _admittance(self) -> Admittance:
        return build_admittance(self.network)


def solve_power_flow(
    network: Network,
    *,
    slack: tuple[int, float] | None = None,
    extra_load: Mapping[int, complex] | None = None,
    tolerance: float = 1e-10,
    max_iterations: int = 30,
) -> PowerFlowResult:
    """Solve ``v conj(ybus v) = s_generation - s_load`` from the flat start.

    Args:
        slack: (bus, vm in p.u.) of a local slack that replaces the network's own, at angle 0.
        extra_load: bus -> complex load in p.u., on top of the network's.
        tolerance: largest power mismatch allowed, p.u.

    Raises:
        InvalidInputError: no slack bus, or buses that it does not reach.
        PowerFlowDivergedError: names the bus with the largest mismatch.
    """
    slack_bus, slack_vm, slack_va = _slack_of(network, slack)
    if unreached := network.find_unreached_buses(slack_bus):
        names = ", ".join(map(str, unreached))
        raise InvalidInputError(
            f"power flow of network {network.name!r}",
            [f"no path of branches in service joins bus {names} to the slack bus {slack_bus}"],
        )
    vm, va = flat_start(network, slack_bus)
    vm, va = vm * slack_vm / vm[network.row[slack_bus]], va + slack_va
    held = {g.bus: g.vm for g in network.generators if g.control is Control.VOLTAGE and g.bus != slack_bus}
    for bus, set_point in held.items():
        vm[network.row[bus]] = set_point
    vm[network.row[slack_bus]] = slack_vm

    scheduled = np.array([network.scheduled_injection(bus.id) for bus in network.buses], dtype=complex)
    for bus, load in (extra_load or {}).items():
        scheduled[network.row[bus]] -= load
    admittance = build_admittance(network)
    p_rows = np.array([network.row[bus.id] for bus in network.buses if bus.id != slack_bus], dtype=int)
    q_rows = np.array([network.row[b.id] for b in network.buses if b.id != slack_bus and b.id not in held], dtype=int)
    x, iterations, mismatch = _newton(
        network, admittance, np.r_[va, vm], scheduled, p_rows, q_rows, tolerance, max_iterations
    )
    if not abs(mismatch).max(initial=0.0) <= tolerance:
        row = int(np.nanargmax(np.where(np.isfinite(mismatch), abs(mismatch), np.inf)))
        bus = network.buses[np.r_[p_rows, q_rows][row]].id
        raise PowerFlowDivergedError(network.name, bus, float(abs(mismatch[row])), iterations)
    va, vm = np.split(x, 2)
    v = vm * np.exp(1j * va)
    return PowerFlowResult(network, vm, va, v * (admittance.ybus @ v).conj(), iterations)


def _slack_of(network: Network, slack: tuple[int, float] | None) -> tuple[int, float, float]:
    if slack is not None:
        return slack[0], slack[1], 0.0
    if network.slack is None:
        raise InvalidInputError(
            f"power flow of network {network.name!r}", ["it has no slack bus; give it one source of kind 'slack'"]
        )
    return network.slack.bus, network.slack.vm, network.slack.va


def _newton(
    network: Network,
    admittance: Admittance,
    x: np.ndarray,
    scheduled: np.ndarray,
    p_rows: np.ndarray,
    q_rows: np.ndarray,
    tolerance: float,
    max_iterations: int,
) -> tuple[np.ndarray, int, np.ndarray]:
    """Newton's iteration on the injections: P of all buses but the slack, Q of those that hold no voltage."""
    buses = [bus.id for bus in network.buses]
    meters = [Meter(MeasurementKind.P_INJECTION, buses[row]) for row in p_rows]
    meters += [Meter(MeasurementKind.Q_INJECTION, buses[row]) for row in q_rows]
    model = build_measurement_model(network, admittance, meters)
    target = np.r_[scheduled.real[p_rows], scheduled.imag[q_rows]]
    unknown = np.r_[p_rows, len(buses) + q_rows]
    mismatch = target - model.predict(x)
    iterations = 0
    while iterations < max_iterations and abs(mismatch).max(initial=0.0) > tolerance:
        iterations += 1
        try:
            step = spla.splu(model.jacobian(x)[:, unknown].tocsc()).solve(mismatch)
        except RuntimeError:  # SuperLU: the Jacobian is singular, the nose of the voltage curve
            break
        x = x.copy()
        x[unknown] += step
        mismatch = target - model.predict(x)
        if not np.isfinite(mismatch).all():
            break
    return x, iterations, mismatch
