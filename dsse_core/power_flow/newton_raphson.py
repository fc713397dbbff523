"""Power flow: the voltages at which every bus meets its scheduled injection, by Newton-Raphson or by sweeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.sparse.linalg as spla

from dsse_core.errors import InvalidInputError, PowerFlowDivergedError
from dsse_core.gauss_newton import LOST, correct_step
from dsse_core.grid.admittance import Admittance, build_admittance
from dsse_core.grid.measurement import Meter, find_meter_problems
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Network
from dsse_core.power_flow.current_sweeps import CurrentSweeps
from dsse_core.power_flow.path_sums import TreePaths, sweep_paths
from dsse_core.power_flow.plan import MethodChoice, PowerFlowPlan, build_power_flow_plan, find_voltages

Method = Literal["sweep", "newton"]


@dataclass(frozen=True, repr=False)
class PowerFlowResult:
    """The solved network. ``vm`` p.u., ``va`` rad, ``injection`` (complex, p.u.): shape (n_nodes,), network order.

    ``iterations`` of ``method``.
    """

    network: Network
    vm: np.ndarray
    va: np.ndarray
    injection: np.ndarray
    iterations: int
    method: Method

    def __repr__(self) -> str:
        return (
            f"<PowerFlowResult of {self.network.name!r}: {len(self.network.buses)} buses, "
            f"losses {self.losses:.4g} p.u., {self.iterations} iterations, {self.method!r}>"
        )

    @property
    def losses(self) -> complex:
        """Series and shunt losses, complex, p.u.: the sum of all injections."""
        return complex(self.injection.sum())

    def read(self, meter: Meter) -> float:
        """The reading of a perfect meter, p.u. or rad.

        Raises:
            InvalidInputError: the meter does not fit the network.
        """
        return float(self.read_all([meter])[0])

    def read_all(self, meters: Sequence[Meter]) -> np.ndarray:
        """The readings of perfect meters, p.u. or rad, shape (n_meas,).

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
    """Solves ``v conj(ybus v) = s_generation - s_load`` at all nodes from the unloaded network with all voltages held.

    Backward and forward sweeps solve it where the network is balanced and radial and no bus but the slack holds its
    voltage, and all networks with phases. Where sweeps do not reach the tolerance, and in all other networks,
    Newton-Raphson does. Nothing is compiled, and numba is not loaded. With phases powers and mismatches are those of
    nodes, loads are the legs.

    Args:
        slack: (bus, vm in p.u.) of a local slack that replaces the network's own, at angle 0.
        extra_load: bus -> complex load in p.u., on top of the network's; with phases at each of them.
        tolerance: largest power mismatch allowed, p.u.; at buses with impedances near zero, round-off.
        max_iterations: of Newton's method.
        method: ``sweep``, ``newton``, or ``auto``: sweeps where they can serve. ``sweep`` falls back on Newton, too.

    Raises:
        InvalidInputError: no slack bus, buses or phases that it does not reach, unknown buses in the arguments, sweeps
            asked for that cannot serve.
        PowerFlowDivergedError: names the bus with the largest mismatch.
    """
    plan = build_power_flow_plan(network, slack=slack, method=method, extra_load=extra_load)
    scheduled = network.scheduled.copy()
    for bus, load in (extra_load or {}).items():
        scheduled[network.nodes_at(bus)] -= load
    return solve_with_plan(plan, scheduled, plan.find_limit(tolerance), max_iterations)


def solve_with_plan(
    plan: PowerFlowPlan, scheduled: np.ndarray, limit: np.ndarray, max_iterations: int
) -> PowerFlowResult:
    """The power flow with injections ``scheduled``, complex, and mismatches up to ``limit``: (n_nodes,), p.u.

    Loads that depend on voltages count in ``scheduled`` as at nominal voltages. Dead nodes have the voltage 0.

    Raises:
        PowerFlowDivergedError: names the bus with the largest mismatch.
    """
    found, lives = _solve(plan, scheduled, limit, max_iterations), ~plan.network.is_dead
    if lives.all():
        return found
    return replace(found, vm=found.vm * lives, va=found.va * lives, injection=found.injection * lives)


def _solve(plan: PowerFlowPlan, scheduled: np.ndarray, limit: np.ndarray, max_iterations: int) -> PowerFlowResult:
    found = None
    if isinstance(plan.paths, TreePaths):
        found = _sweep(plan.paths, plan, scheduled, limit)
    elif isinstance(plan.paths, CurrentSweeps):
        found = _sweep_currents(plan.paths, plan, scheduled, limit)
    if found is not None:
        return found
    return solve_by_newton(plan, scheduled, limit, max_iterations)


def solve_by_newton(
    plan: PowerFlowPlan, scheduled: np.ndarray, limit: np.ndarray, max_iterations: int
) -> PowerFlowResult:
    """The power flow of ``solve_with_plan`` by Newton-Raphson only.

    Raises:
        PowerFlowDivergedError: names the bus with the largest mismatch.
    """
    x, iterations = _newton(plan, scheduled, limit, max_iterations)
    va, vm = np.split(x, 2)
    v = find_voltages(x)
    injection = v * (plan.admittance.ybus @ v).conj()
    return PowerFlowResult(plan.network, vm, va, injection, iterations, "newton")


def _sweep(paths: TreePaths, plan: PowerFlowPlan, scheduled: np.ndarray, limit: np.ndarray) -> PowerFlowResult | None:
    """The result; None where sweeps do not converge, or a bus but the root does not meet its schedule to ``limit``."""
    if (found := sweep_paths(paths, scheduled)) is None:
        return None
    u, injection, sweeps = found
    mismatch = abs(injection - scheduled)
    mismatch[paths.order[0]] = 0.0
    if not (mismatch <= limit).all():
        return None
    va, vm = np.split(plan.start, 2)
    return PowerFlowResult(plan.network, vm * abs(u), va + np.angle(u), injection, sweeps, "sweep")


def _sweep_currents(
    sweeps: CurrentSweeps, plan: PowerFlowPlan, scheduled: np.ndarray, limit: np.ndarray
) -> PowerFlowResult | None:
    """The result; None where sweeps do not settle, or a node away from the source does not meet its schedule."""
    if (found := sweeps.run(scheduled)) is None:
        return None
    v, n_sweeps = found
    va, _ = np.split(plan.start, 2)
    va, vm = va + np.angle(v * plan.start_voltage.conj()), abs(v)
    rows = plan.p_rows
    p, q = plan.find_injections(np.concatenate([va, vm])).reshape(2, -1)
    if not (np.maximum(abs(p - scheduled.real[rows]), abs(q - scheduled.imag[rows])) <= limit[rows]).all():
        return None
    injection = v * (plan.admittance.ybus @ v).conj()
    return PowerFlowResult(plan.network, vm, va, injection, n_sweeps, "sweep")


def _newton(
    plan: PowerFlowPlan, scheduled: np.ndarray, limit: np.ndarray, max_iterations: int
) -> tuple[np.ndarray, int]:
    """State x and number of steps of Newton's iteration on P of all buses but the slack and Q of buses that hold no
    voltage.

    Raises:
        PowerFlowDivergedError: names the bus with the largest mismatch.
    """
    p_rows, q_rows, x = plan.p_rows, plan.q_rows, plan.start
    rows = np.r_[p_rows, q_rows]
    target = np.r_[scheduled.real[p_rows], scheduled.imag[q_rows]]
    unknown = np.r_[p_rows, plan.network.n_nodes + q_rows]
    limit = limit[rows]
    mismatch = target - plan.find_injections(x)
    iterations = 0
    while (abs(mismatch) > limit).any():
        following = _newton_step(plan, x, target, unknown, mismatch) if iterations < max_iterations else None
        if following is None:
            worst = int(np.argmax(abs(mismatch)))
            bus = plan.network.buses[plan.network.table.nodes.item[rows[worst]]].id
            raise PowerFlowDivergedError(plan.network.name, bus, float(abs(mismatch[worst])), iterations)
        x, mismatch = following
        iterations += 1
    return x, iterations


def _newton_step(
    plan: PowerFlowPlan, x: np.ndarray, target: np.ndarray, unknown: np.ndarray, mismatch: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """The next state and its mismatch; None at the nose of the voltage curve (singular) or out of all bounds.

    No step moves a voltage by more than MAX_DVM and MAX_DVA, as in the estimate.
    """
    try:
        step = spla.splu(plan.newton_matrix(x, mismatch)[:, unknown].tocsc()).solve(mismatch)
    except RuntimeError:  # SuperLU: exactly singular
        return None
    whole = np.zeros(len(x))
    whole[unknown] = step
    dva, dvm = abs(whole).reshape(2, -1).max(axis=1).tolist()
    verdict, share = correct_step(1.0, stepped=True, flows_known=True, dva=dva, dvm=dvm)
    if verdict == LOST:
        return None
    x = x + share * whole
    return None if (x[len(x) // 2 :] <= 0).any() else (x, target - plan.find_injections(x))
