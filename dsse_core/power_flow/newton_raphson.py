"""Power flow: the voltages at which every bus meets its scheduled injection, by Newton-Raphson or by sweeps."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import scipy.sparse.linalg as spla

from dsse_core.errors import InvalidInputError, PowerFlowDivergedError
from dsse_core.grid.admittance import Admittance, build_admittance, flat_start
from dsse_core.grid.measurement import MeasurementKind, Meter, find_meter_problems
from dsse_core.grid.measurement_model import MeasurementModel, build_measurement_model
from dsse_core.grid.network import Control, Network
from dsse_core.radial.plan import RadialLayout, lay_out_radial

LARGEST_STEP = 1e6  # p.u. or rad; beyond it there is nothing to find
Method = Literal["sweep", "newton"]
MethodChoice = Literal["auto", "sweep", "newton"]
# Of a radial network from which on ``auto`` loads numba: 0.3 s, and sweeps save 13 us per bus.
FEWEST_BUSES_OF_SWEEP = 20_000
ROUND_OFF = 1e-15  # of the sum of a bus' admittances: what its mismatch cannot fall below


@dataclass(frozen=True)
class PowerFlowResult:
    """The solved network. ``vm`` p.u., ``va`` rad, ``injection`` (complex, p.u.): shape (n_bus,), network order.

    ``iterations`` of ``method``.
    """

    network: Network
    vm: np.ndarray
    va: np.ndarray
    injection: np.ndarray
    iterations: int
    method: Method

    @property
    def losses(self) -> complex:
        """Series and shunt losses, p.u.: everything that is injected and not taken out again."""
        return complex(self.injection.sum())

    def read(self, meter: Meter) -> float:
        """What a perfect meter would read, p.u. or rad.

        Raises:
            InvalidInputError: the meter does not fit the network.
        """
        return float(self.read_all([meter])[0])

    def read_all(self, meters: Sequence[Meter]) -> np.ndarray:
        """What perfect meters would read, p.u. or rad, shape (n_meas,).

        Raises:
            InvalidInputError: listing every meter that does not fit the network or is given twice.
        """
        if problems := list(find_meter_problems(self.network, meters)):
            raise InvalidInputError(f"meters of network {self.network.name!r}", problems)
        model = build_measurement_model(self.network, self.admittance, meters)
        return model.predict(np.r_[self.va, self.vm])

    @cached_property
    def admittance(self) -> Admittance:
        return build_admittance(self.network)


def solve_power_flow(
    network: Network,
    *,
    slack: tuple[int, float] | None = None,
    extra_load: Mapping[int, complex] | None = None,
    tolerance: float = 1e-10,
    max_iterations: int = 30,
    method: MethodChoice = "auto",
) -> PowerFlowResult:
    """Solve ``v conj(ybus v) = s_generation - s_load`` from the flat start.

    By backward and forward sweeps where numba is installed, the network radial, with FEWEST_BUSES_OF_SWEEP buses or
    more, and no bus but the slack holds its voltage; where they do not reach the tolerance, and else, by
    Newton-Raphson.

    Args:
        slack: (bus, vm in p.u.) of a local slack that replaces the network's own, at angle 0.
        extra_load: bus -> complex load in p.u., on top of the network's.
        tolerance: largest power mismatch allowed, p.u.; at buses with impedances near zero, round-off.
        max_iterations: of Newton's method.
        method: ``sweep`` at any size, ``newton``, or ``auto``.

    Raises:
        InvalidInputError: no slack bus, buses that it does not reach, unknown buses in the arguments, sweeps asked for
            that cannot serve.
        PowerFlowDivergedError: names the bus with the largest mismatch.
    """
    extra_load = extra_load or {}
    slack_bus, slack_vm, slack_va = _slack_of(network, slack)
    if problems := list(_find_problems(network, slack_bus, slack_vm, extra_load)):
        raise InvalidInputError(f"power flow of network {network.name!r}", problems)
    held = {g.bus: g.vm for g in network.generators if g.control is Control.VOLTAGE} | {slack_bus: slack_vm}
    vm, va = flat_start(network, slack_bus)
    for bus, set_point in held.items():
        vm[network.row[bus]] = set_point
    scheduled = np.array([network.scheduled_injection(bus.id) for bus in network.buses], dtype=complex)
    for bus, load in extra_load.items():
        scheduled[network.row[bus]] -= load
    admittance = build_admittance(network)
    x = np.r_[va + slack_va, vm]
    limit = np.maximum(tolerance, ROUND_OFF * abs(admittance.ybus).sum(axis=1))
    layout = _lay_out(network, slack_bus, held, method)
    if not isinstance(layout, str) and (found := _sweep(layout, network, admittance, x, scheduled, limit)):
        return found
    p_rows = np.array([network.row[bus.id] for bus in network.buses if bus.id != slack_bus], dtype=int)
    q_rows = np.array([network.row[bus.id] for bus in network.buses if bus.id not in held], dtype=int)
    x, iterations = _newton(network, admittance, x, scheduled, p_rows, q_rows, limit, max_iterations)
    va, vm = np.split(x, 2)
    v = vm * np.exp(1j * va)
    return PowerFlowResult(network, vm, va, v * (admittance.ybus @ v).conj(), iterations, "newton")


def _lay_out(network: Network, slack_bus: int, held: Mapping[int, float], method: MethodChoice) -> RadialLayout | str:
    """The tree to sweep over, or why not.

    Raises:
        InvalidInputError: sweeps are asked for and cannot serve.
    """
    n = len(network.buses)
    if method not in get_args(MethodChoice):
        known = ", ".join(get_args(MethodChoice))
        raise InvalidInputError("power flow", [f"method is {method!r}; choose one of {known}"])
    if method == "newton" or (method == "auto" and n < FEWEST_BUSES_OF_SWEEP):
        return "not asked for"
    layout: RadialLayout | str = "other buses than the slack hold their voltage"
    if len(held) == 1:
        layout = lay_out_radial(network, slack_bus)
    if isinstance(layout, str) and method == "sweep":
        problem = f"sweeps cannot serve: {layout}; choose 'auto' or 'newton'"
        raise InvalidInputError(f"power flow of network {network.name!r}", [problem])
    return layout


def _sweep(
    layout: RadialLayout,
    network: Network,
    admittance: Admittance,
    x: np.ndarray,
    scheduled: np.ndarray,
    limit: np.ndarray,
) -> PowerFlowResult | None:
    """The result, unless some bus but the root does not meet its schedule to ``limit``."""
    from dsse_core.power_flow.sweeps import sweep_power_flow  # numba: only where it is used

    va, vm = np.split(x, 2)
    if (found := sweep_power_flow(network, layout, scheduled, vm * np.exp(1j * va))) is None:
        return None
    v, sweeps = found
    injection = v * (admittance.ybus @ v).conj()
    mismatch = abs(injection - scheduled)
    mismatch[layout.order[0]] = 0.0
    if (mismatch > limit).any():
        return None
    root = layout.order[0]
    vm, va = np.where(np.arange(len(v)) == root, vm, abs(v)), va + np.angle(v * np.exp(-1j * va))
    return PowerFlowResult(network, vm, va, injection, sweeps, "sweep")


def _find_problems(
    network: Network, slack_bus: int, slack_vm: float, extra_load: Mapping[int, complex]
) -> Iterator[str]:
    if slack_bus not in network.row:
        yield f"the slack bus {slack_bus} is not in the network"
    elif unreached := network.find_unreached_buses(slack_bus):
        names = ", ".join(map(str, unreached))
        yield f"no path of branches in service joins bus {names} to the slack bus {slack_bus}"
    if not (math.isfinite(slack_vm) and slack_vm > 0):
        yield f"the slack voltage is {slack_vm}; it must be a positive number in p.u."
    for bus, load in extra_load.items():
        if bus not in network.row:
            yield f"extra load at bus {bus}, which is not in the network"
        if not cmath.isfinite(load):
            yield f"the extra load at bus {bus} is {load}, not a finite number"


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
    limit: np.ndarray,
    max_iterations: int,
) -> tuple[np.ndarray, int]:
    """Newton's iteration on the injections: P of all buses but the slack, Q of those that hold no voltage."""
    buses = [bus.id for bus in network.buses]
    rows = np.r_[p_rows, q_rows]
    meters = [Meter(MeasurementKind.P_INJECTION, buses[row]) for row in p_rows]
    meters += [Meter(MeasurementKind.Q_INJECTION, buses[row]) for row in q_rows]
    model = build_measurement_model(network, admittance, meters)
    target = np.r_[scheduled.real[p_rows], scheduled.imag[q_rows]]
    unknown = np.r_[p_rows, len(buses) + q_rows]
    limit = limit[rows]
    mismatch = target - model.predict(x)
    iterations = 0
    while (abs(mismatch) > limit).any():
        following = _newton_step(model, x, target, unknown, mismatch) if iterations < max_iterations else None
        if following is None:
            worst = int(np.argmax(abs(mismatch)))
            raise PowerFlowDivergedError(network.name, buses[rows[worst]], float(abs(mismatch[worst])), iterations)
        x, mismatch = following
        iterations += 1
    return x, iterations


def _newton_step(
    model: MeasurementModel, x: np.ndarray, target: np.ndarray, unknown: np.ndarray, mismatch: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """The next state and its mismatch; None at the nose of the voltage curve (singular) or out of all bounds."""
    try:
        step = spla.splu(model.jacobian(x)[:, unknown].tocsc()).solve(mismatch)
    except RuntimeError:  # SuperLU: exactly singular
        return None
    x = x.copy()
    x[unknown] += step
    if not abs(step).max(initial=0.0) < LARGEST_STEP or (x[len(x) // 2 :] == 0).any():
        return None
    return x, target - model.predict(x)
