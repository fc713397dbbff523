"""Many power flows of one network at once, on all processors, a result or a failure for each."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from dsse_core.compiling import find_obstacle
from dsse_core.errors import InvalidInputError, PowerFlowDivergedError
from dsse_core.grid.network import Network
from dsse_core.power_flow.newton_raphson import PowerFlowResult, solve_by_newton, solve_with_plan
from dsse_core.power_flow.path_sums import TreePaths
from dsse_core.power_flow.plan import MethodChoice, PowerFlowPlan, build_power_flow_plan
from dsse_core.row_threads import find_threads, share_out

Solve = Callable[[PowerFlowPlan, np.ndarray, np.ndarray, int], PowerFlowResult]
COMPILED = "dsse_core.power_flow.sweeps"  # the module
# Loading numba takes 0.3 s of a processor. Rows in numpy take as long with so many buses; each row counts as so many
# more.
FEWEST_BUSES_OF_COMPILED, BUSES_OF_A_ROW = 500_000, 400


@dataclass(frozen=True, repr=False)
class PowerFlowBatch:
    """The solved rows. ``vm`` p.u., ``va`` rad: shape (n_row, n_nodes), network order; ``iterations`` (n_row,).

    ``failures``: row -> why it has no result, as text; its numbers are NaN, its iterations 0.
    """

    network: Network
    vm: np.ndarray
    va: np.ndarray
    iterations: np.ndarray
    failures: Mapping[int, str]

    def __repr__(self) -> str:
        rows, buses, failures = len(self.vm), len(self.network.buses), len(self.failures)
        return f"<PowerFlowBatch of {self.network.name!r}: {rows} rows, {buses} buses, {failures} failures>"


def solve_power_flow_batch(
    network: Network | PowerFlowPlan,
    p: np.ndarray,
    q: np.ndarray,
    *,
    tolerance: float = 1e-10,
    max_iterations: int = 30,
    method: MethodChoice = "auto",
    threads: int | None = None,
) -> PowerFlowBatch:
    """The power flow of each row of injections ``p`` and ``q``, p.u., (n_row, n_nodes), network order.

    Injections of the slack bus do not count, nor does q of a bus that holds its voltage.

    Args:
        network: the network, or its plan: the plan sets the method, and compiled code is loaded or made at once.
        tolerance, max_iterations, method: see ``solve_power_flow``. Sweeps are compiled where that code is loaded
            already, where a plan is given, and where the rows are so many that loading numba pays.
        threads: number of threads; all processors by default. The results do not depend on it.

    Raises:
        InvalidInputError: shapes that do not fit; a network that ``solve_power_flow`` rejects.
    """
    p, q = np.ascontiguousarray(p, dtype=float), np.ascontiguousarray(q, dtype=float)
    n = (network if isinstance(network, Network) else network.network).n_nodes
    if p.ndim != 2 or p.shape != q.shape or p.shape[1] != n:
        problem = f"p and q have shapes {p.shape} and {q.shape}; give (number of rows, {n}) for both"
        raise InvalidInputError("injections of a batch of power flows", [problem])
    is_kept = not isinstance(network, Network)
    plan = build_power_flow_plan(network, method=method) if isinstance(network, Network) else network
    vm, va = np.full((2, *p.shape), np.nan)
    limit, iterations = plan.find_limit(tolerance), np.zeros(len(p), dtype=np.int64)
    rows = _Rows(plan, p, q, limit, max_iterations, vm, va, iterations, {})
    is_compiled = isinstance(plan.paths, TreePaths) and _pays(plan, len(p), is_kept) and find_obstacle("batch") is None
    share_out(len(p), find_threads(threads), rows.by_sweeps if is_compiled else rows.one_by_one)
    return PowerFlowBatch(plan.network, rows.vm, rows.va, rows.iterations, dict(sorted(rows.failures.items())))


def _pays(plan: PowerFlowPlan, n_row: int, is_kept: bool) -> bool:
    """True where compiled sweeps pay, or are loaded already."""
    pays = n_row * (len(plan.network.buses) + BUSES_OF_A_ROW) >= FEWEST_BUSES_OF_COMPILED
    return pays or is_kept or COMPILED in sys.modules


@dataclass(frozen=True)
class _Rows:
    """The rows to solve, and the arrays to fill."""

    plan: PowerFlowPlan
    p: np.ndarray
    q: np.ndarray
    limit: np.ndarray
    max_iterations: int
    vm: np.ndarray
    va: np.ndarray
    iterations: np.ndarray
    failures: dict[int, str]

    def one_by_one(self) -> Callable[[int, int], None]:
        def do(first: int, end: int) -> None:
            for k in range(first, end):
                self._do_alone(k, solve_with_plan)

        return do

    def by_sweeps(self) -> Callable[[int, int], None]:
        """The function that solves rows by compiled sweeps, and by Newton's method those that sweeps do not solve."""
        from dsse_core.power_flow.sweeps import build_tables, sweep_rows  # numba

        plan, paths = self.plan, self.plan.paths
        assert isinstance(paths, TreePaths)
        n, order = len(paths.order), paths.order
        tables = build_tables(plan.network, paths)
        start = plan.start_voltage[order], plan.start[order]
        memory = np.empty((3, n), dtype=complex)

        def do(first: int, end: int) -> None:
            here = slice(first, end)
            met = np.empty(end - first, dtype=bool)
            sweep_rows(
                order, paths.parent, *tables, *start, self.limit[order], self.p[here], self.q[here], *memory,
                self.vm[here], self.va[here], self.iterations[here], met,
            )  # fmt: skip
            root = order[0]
            self.vm[here, root] = np.where(met, plan.start[n + root], np.nan)
            for k in np.flatnonzero(~met).tolist():
                self._do_alone(first + k, solve_by_newton)

        return do

    def _do_alone(self, k: int, solve: Solve) -> None:
        scheduled = self.p[k] + 1j * self.q[k]
        counted = scheduled[self.plan.p_rows].real, scheduled[self.plan.q_rows].imag
        self.iterations[k] = 0
        if not all(np.isfinite(part).all() for part in counted):
            self.failures[k] = "an injection is not a finite number"
            return
        try:
            found = solve(self.plan, scheduled, self.limit, self.max_iterations)
        except PowerFlowDivergedError as error:
            self.failures[k] = str(error)
        else:
            self.vm[k], self.va[k], self.iterations[k] = found.vm, found.va, found.iterations
