"""The estimate of one large radial network on several threads: the passes of ``radial.kernel``, feeder by feeder.

The feeders below the first fork are independent of each other. Every thread has some of them, whose buses are numbered
in one piece. In each step every thread eliminates its buses. Then the trunk, from the root to the fork, is solved, and
every thread substitutes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from dsse_core.gauss_newton import GO_ON, LOST, USE_CURRENTS, correct_step, is_out_of_reach, next_step
from dsse_core.radial.plan import RadialPlan

Span = tuple[int, int]


def find_feeders(parent: np.ndarray, threads: int) -> tuple[int, list[Span]]:
    """The bus of the first fork, and for each thread the first of its buses and the bus after its last.

    The parts are as even as the feeders allow. There are fewer than ``threads`` parts where feeders are fewer, and none
    where the network has no fork.
    """
    n = len(parent)
    children = np.bincount(parent[1:], minlength=n)
    fork = int(np.argmax(children != 1))  # before it each bus is followed by its only child
    heads = np.flatnonzero(parent == fork)
    heads = heads[heads > fork]
    if len(heads) == 0:
        return fork, []
    wanted = fork + 1 + np.arange(1, threads) * (n - fork - 1) / threads
    cuts = heads[np.searchsorted(heads, wanted).clip(max=len(heads) - 1)]
    bounds = np.unique(np.concatenate([[fork + 1], cuts, [n]])).tolist()
    return fork, list(itertools.pairwise(bounds))


class FeederIteration:
    """One iteration on several threads: each of the ``spans`` of buses below ``fork`` has its own thread.

    See ``iteration.estimate``.
    """

    def __init__(self, plan: RadialPlan, pool: ThreadPoolExecutor, threads: int, space: np.ndarray) -> None:
        from dsse_core.radial import iteration, kernel, root

        self._plan, self._pool, n = plan, pool, len(plan.order)
        self._iteration, self._kernel, self._root = iteration, kernel, root
        self._fork, self._spans = find_feeders(plan.parent, threads)
        states, (self._z, self._w), work = iteration.carve(space, n)
        self._v: np.ndarray = states[0]
        self._va: np.ndarray = states[1]
        self._to: tuple[np.ndarray, np.ndarray] = states[2:]
        self._trunk, self._factor, self._more, self._block, self._step = work
        self._row = np.arange(n)  # of the steps: threads have no row in common but that of the fork
        self._above = [np.zeros((int(plan.level.max()) + 1, root.N_KNOWN)) for _ in self._spans]
        self._blocks = [np.empty_like(self._block) for _ in self._spans]

    def _spread(self, do: Callable[[int, Span], Any]) -> list[Any]:
        return [future.result() for future in [self._pool.submit(do, k, span) for k, span in enumerate(self._spans)]]

    def _pass_to_fork(self) -> None:
        """Adds what the threads have found about the fork to the memory of the trunk."""
        at = self._plan.level[self._fork]
        for above in self._above:
            self._trunk[at] += above[at]
            above[at] = 0.0

    def begin(
        self, start: np.ndarray, start_va: np.ndarray, exact: np.ndarray, values: np.ndarray, sigmas: np.ndarray
    ) -> bool:
        """Stores the readings and the start; True where all readings are there and usable."""

        def store(_: int, span: Span) -> int:
            here = slice(*span)
            self._v[here], self._va[here] = start[here], start_va[here]
            of_buses = self._plan.meter[here], exact, values, sigmas, self._z[here], self._w[here]
            missing: int = self._iteration.store(*of_buses)
            return missing

        return not any([store(0, (0, self._fork + 1)), *self._spread(store)])

    def iterate(self, tolerance: float, most_steps: int, limit: float) -> tuple[int, int, float]:
        """End, number of steps and size of the last one, by the same lines as ``iteration.iterate``."""
        has_currents, small = self._plan.has_currents, self._kernel.SMALL_ANGLE
        flows_known, stepped, end = not has_currents, False, GO_ON
        steps, share, largest, before = 0, 1.0, 0.0, 0.0
        while end == GO_ON:
            J = self._eliminate(flows_known)
            end, share, before = next_step(
                steps, share, stepped, before, largest, flows_known, has_currents, J, limit, tolerance, most_steps
            )
            if end == LOST:
                break
            dva, dvm, finite = self._descend(share)
            steps, stepped, largest = steps + 1, end == GO_ON, max(dva, dvm) if finite else np.inf
            verdict, length = correct_step(share, stepped, flows_known, dva if finite else np.inf, dvm)
            if verdict == LOST or is_out_of_reach(dvm):
                return LOST, steps, largest
            if length != share or not length * dva < small:
                halves = self._kernel.count_halves(length * dva)
                self._descend(length / halves)
                if halves > 1.0:
                    self._kernel.stretch(self._v, self._va, *self._to, halves)
            (self._v, self._va), self._to = self._to, (self._v, self._va)
            stepped = verdict == GO_ON
            flows_known = flows_known or verdict == USE_CURRENTS
        return end, steps, largest

    def _eliminate(self, flows_known: bool) -> float:
        """Eliminates all buses, fills the root's row of the step, and returns J."""
        plan, v, va = self._plan, self._v, self._va

        def up(span: Span, above: np.ndarray, block: np.ndarray) -> float:
            J: float = self._kernel.eliminate(
                *span, plan.parent, plan.admittance, self._z, self._w, v, va, flows_known, self._kernel.STEP,
                plan.level, above, self._factor, self._more, block, 0.0,
            )[2]  # fmt: skip
            return J

        J = sum(self._spread(lambda k, span: up(span, self._above[k], self._blocks[k])))
        self._pass_to_fork()
        J += up((1, self._fork + 1), self._trunk, self._block)
        at_root = plan.admittance[0], self._z[0], self._w[0], v[0], va[0], self._trunk[0]
        J += self._root.find_root_objective(*at_root)
        self._root.solve_root(*at_root, True, False, self._block, self._step)
        return float(J)

    def _descend(self, length: float) -> tuple[float, float, bool]:
        """``kernel.descend`` of all buses, after that of the root."""

        def down(_: int, span: Span) -> tuple[float, float, bool]:
            largest: tuple[float, float, bool] = self._kernel.descend(
                *span, self._plan.parent, self._row, self._factor, self._v, self._va, self._step, length, *self._to,
            )  # fmt: skip
            return largest

        dva, dvm, finite = zip(down(0, (0, self._fork + 1)), *self._spread(down), strict=True)
        return max(dva), max(dvm), all(finite)

    def finish(self, state: np.ndarray, residual: np.ndarray) -> float:
        """Fills ``state`` (2, n_bus) and ``residual`` (n_meas,); returns J."""
        plan, v, va = self._plan, self._v, self._va

        def read(span: Span, above: np.ndarray) -> float:
            here, rows = slice(*span), plan.order[slice(*span)]
            state[0, rows], state[1, rows] = abs(v[here]), va[here]
            J: float = self._iteration.find_residuals(
                *span, plan.parent, plan.level, plan.admittance, self._z, self._w, v, va, plan.has_currents,
                plan.meter, above, np.empty(self._block.shape[1]), residual,
            )  # fmt: skip
            return J

        J = sum(self._spread(lambda k, span: read(span, self._above[k])))
        self._pass_to_fork()
        return float(J) + read((0, self._fork + 1), self._trunk)


def estimate_on_threads(
    plan: RadialPlan,
    exact: np.ndarray,
    values: np.ndarray,
    sigmas: np.ndarray,
    space: np.ndarray,
    start: np.ndarray,
    start_va: np.ndarray,
    tolerance: float,
    most_steps: int,
    limit: float,
    state: np.ndarray,
    residual: np.ndarray,
    threads: int,
) -> tuple[int, int, float, float]:
    """``iteration.estimate`` on ``threads`` threads: fills the same arrays and returns the same numbers."""
    from dsse_core.radial.iteration import UNUSABLE

    with ThreadPoolExecutor(threads) as pool:
        iteration = FeederIteration(plan, pool, threads, space)
        if not iteration.begin(start, start_va, exact, values, sigmas):
            return UNUSABLE, 0, np.inf, np.inf
        end, steps, largest = iteration.iterate(tolerance, most_steps, limit)
        return end, steps, largest, iteration.finish(state, residual)
