"""Cause of an iteration without end, found by estimating once more without the meters that may be the cause.

The state where the iteration has stopped is no estimate, so that residuals there accuse any meter. A meter is named
only if the other meters have an estimate, agree on it, and the meter's reading lies far from it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from dsse_core.errors import BELIEVABLE, EstimationDivergedError, InvalidInputError, NotObservableError
from dsse_core.estimation.decision import IterationLostError, Memory
from dsse_core.estimation.plan import EstimationPlan
from dsse_core.estimation.residuals import THRESHOLD
from dsse_core.estimation.result import EstimationResult
from dsse_core.gauss_newton import MAX_DVA, MAX_DVM, Solution, are_magnitudes
from dsse_core.grid.admittance import build_admittance, flat_start
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.meter_table import QUANTITY, number_kinds
from dsse_core.grid.network import Network
from dsse_core.grid.quantities import Quantity

MOST_SUSPECTS = 3  # meters; without each of them the state is estimated once more


class Estimate(Protocol):
    """Signature of ``iterate_with_plan``."""

    def __call__(
        self, plan: EstimationPlan, values: np.ndarray, sigmas: np.ndarray, *, memory: Memory
    ) -> EstimationResult: ...


def explain_divergence(
    plan: EstimationPlan, values: np.ndarray, sigmas: np.ndarray, lost: IterationLostError, estimate: Estimate
) -> EstimationDivergedError:
    """Error that names the cause why ``estimate`` has ``lost`` the iteration for ``values``, ``sigmas``, (n_meas,)."""
    sigmas = np.where(plan.virtual, 0.0, sigmas)
    for row in _find_suspects(plan, lost.weighted):
        rest = _estimate_without(plan, values, sigmas, [row], estimate)
        if rest is None or rest.memory.evaluating:
            continue
        distance = _find_distance(rest, plan, row, float(values[row]), float(sigmas[row]))
        if distance > BELIEVABLE:
            cause = (
                f"without {plan.meters[row]} it does, and that reading lies {distance:.3g} standard deviations from "
                "the other readings; check that meter's value, sign and unit"
            )
            return EstimationDivergedError(lost.iterations, lost.step, cause, plan.meters[row].id, lost.reason)
    cause = lost.cause or _find_cause(plan, values, sigmas, estimate)
    return EstimationDivergedError(lost.iterations, lost.step, cause, reason=lost.reason)


def explain_magnitudes(network: Network, x: np.ndarray) -> str:
    """Text that names the magnitude of x = [va; vm; ...] that is not above 0; empty where there is none."""
    vm = np.where(network.is_dead, 1.0, x[network.n_nodes : 2 * network.n_nodes])
    if are_magnitudes(vm):
        return ""
    row = int(np.argmin(vm))
    return (
        f"it has come to {vm[row]:.3g} p.u. at bus {network.node_names[row]}, where no grid is; check the readings "
        "there, and with phases whether shunts join some of them to ground far more firmly than others"
    )


def _find_suspects(plan: EstimationPlan, weighted: np.ndarray) -> list[int]:
    """Rows of the meters farthest from the state at the end, the farthest first."""
    size = np.where(plan.virtual | ~np.isfinite(weighted), 0.0, weighted)
    farthest = np.argsort(-size, kind="stable")[:MOST_SUSPECTS]
    return [int(row) for row in farthest if size[row] > BELIEVABLE]


def _estimate_without(
    plan: EstimationPlan, values: np.ndarray, sigmas: np.ndarray, rows: list[int], estimate: Estimate
) -> EstimationResult | None:
    """The estimate from the flat start without the meters at ``rows``, if there is one."""
    try:
        without = plan.without(rows)
        anew = Memory(from_flat_start=True)
        return estimate(without, np.delete(values, rows), np.delete(sigmas, rows), memory=anew)
    except (IterationLostError, NotObservableError, InvalidInputError):
        return None


def _find_distance(rest: EstimationResult, plan: EstimationPlan, row: int, value: float, sigma: float) -> float:
    """|z - h(x)| / sqrt(sigma^2 + H P H') of a meter that is not in the estimate ``rest`` with covariance P."""
    admittance, first_tap = build_admittance(plan.network), 2 * plan.network.n_nodes
    model, x = build_measurement_model(plan.network, admittance, [plan.meters[row]], first_tap=first_tap), rest.x
    variance = float(rest.linear.covariance(x, {}, model.jacobian(x).toarray())[0, 0])
    error = float(model.subtract(np.array([value]), model.predict(x))[0])
    return abs(error) / float(np.hypot(sigma, np.sqrt(max(variance, 0.0))))


def _find_cause(plan: EstimationPlan, values: np.ndarray, sigmas: np.ndarray, estimate: Estimate) -> str:
    """Text of the cause that keeps the iteration from its end, where no single reading is the cause."""
    currents = np.flatnonzero(QUANTITY[number_kinds(plan.meters)] == Quantity.CURRENT).tolist()
    if currents and _estimate_without(plan, values, sigmas, currents, estimate) is not None:
        return (
            f"without its {len(currents)} current magnitudes it does: they do not say where to these currents flow; "
            "meter P and Q there, or leave the meters of currents out"
        )
    if weakest := _find_weakest(plan.without(currents) if currents else plan, np.delete(sigmas, currents)):
        return weakest
    known = sigmas[sigmas > 0]
    spread = f", from {known.min():.2g} to {known.max():.2g} p.u. or rad here" if len(known) else ""
    return (
        "no single reading is the cause: look for several wrong readings, for branches of next to no impedance, and "
        f"for standard deviations many decades apart{spread}"
    )


def _find_weakest(plan: EstimationPlan, sigmas: np.ndarray) -> str:
    """Text that names the bus whose voltage noise alone moves farther than a step may be long, at the flat start.

    Empty where noise moves no voltage so far, or where the deviations cannot be computed.
    """
    vm, va = flat_start(plan.network, plan.reference)
    nothing: Solution = vm, va, np.zeros(len(sigmas)), 0.0, 0
    try:
        found = EstimationResult(
            plan, np.zeros(len(sigmas)), sigmas, Memory(), *nothing, plan.network.taps
        ).state_sigma()
    except RuntimeError:  # SuperLU: singular by rounding
        return ""
    of_kinds = zip(("magnitude", "angle"), found, (MAX_DVM, MAX_DVA), ("p.u.", "rad"), strict=True)
    for name, deviation, longest, unit in of_kinds:
        row = int(np.argmax(np.nan_to_num(deviation)))
        if THRESHOLD * deviation[row] > longest:
            bus = plan.network.table.bus_id[plan.network.table.nodes.item[row]]
            return (
                f"the readings hardly determine the {name} at bus {bus}: its standard deviation "
                f"is {deviation[row]:.2g} {unit}; add a voltmeter there, or power meters around it"
            )
    return ""
