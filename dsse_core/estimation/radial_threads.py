"""The estimate of one large radial network on several threads: the steps of ``radial.iteration``, feeder by feeder."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from dsse_core.gauss_newton import GO_ON, LOST, USE_CURRENTS, correct_step, is_out_of_reach, next_step
from dsse_core.radial.plan import RadialPlan

Span = tuple[int, int]
Ended = tuple[int, int, float, float]


@dataclass
class FeederIteration:
    """One iteration on several threads: each of the ``spans`` of buses below ``fork`` has its own thread.

    See ``iteration.estimate``.
    """

    plan: RadialPlan
    pool: ThreadPoolExecutor
    fork: int
    spans: list[Span]
    exact: np.ndarray
    values: np.ndarray
    sigmas: np.ndarray
    space: np.ndarray
    share: float = 0.0  # of the last step, which the feeders have still to take
    dva: float = 0.0
    to_fork: np.ndarray = field(init=False)
    above: list[np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        deepest = int(self.plan.level.max())
        self.to_fork = np.zeros((len(self.spans), 16))
        self.above = [np.zeros((deepest + 1, 16)) for _ in self.spans]

    @cached_property
    def _views(self) -> tuple[Any, ...]:
        from dsse_core.radial import iteration

        views: tuple[Any, ...] = iteration.carve(self.space, len(self.plan.order))
        return views

    def _spread(self, do: Callable[[int, Span], Any], spans: list[Span]) -> list[Any]:
        return [future.result() for future in [self.pool.submit(do, k, span) for k, span in enumerate(spans)]]

    @property
    def _meters(self) -> list[Span]:
        bounds = np.linspace(0, len(self.values), max(1, len(self.spans)) + 1).astype(int).tolist()
        return list(itertools.pairwise(bounds))

    def begin(self, start: np.ndarray, start_va: np.ndarray) -> bool:
        """Stores the readings and ``start``; True where all readings are usable."""
        from dsse_core.radial import iteration

        v, va, z, w, *_ = self._views

        def store(_: int, span: Span) -> bool:
            here = slice(*span)
            v[here], va[here] = start[here], start_va[here]
            usable: bool = iteration.store(
                self.plan.meter[here], self.exact, self.values, self.sigmas, z[here], w[here]
            )
            return usable

        self.share = 0.0
        of_trunk = store(0, (0, self.fork + 1))
        return all(self._spread(store, self.spans)) and of_trunk

    def iterate(self, tolerance: float, most_steps: int, limit: float) -> tuple[int, int, float]:
        """End, number of steps and size of the last one, by the same lines as ``iteration.iterate``."""
        has_currents = self.plan.has_currents
        flows_known, stepped, end = not has_currents, False, GO_ON
        steps, taken, largest, before = 0, 1.0, 0.0, 0.0
        while end == GO_ON:
            J, self.dva, dvm, finite = self._step(flows_known)
            end, taken, before = next_step(
                steps, taken, stepped, before, largest, flows_known, has_currents, J, limit, tolerance, most_steps
            )
            if end == LOST:
                break
            steps, stepped, largest = steps + 1, end == GO_ON, max(self.dva, dvm) if finite else np.inf
            verdict, self.share = correct_step(taken, stepped, flows_known, self.dva if finite else np.inf, dvm)
            if verdict == LOST or is_out_of_reach(dvm):
                return LOST, steps, largest
            self._move_trunk()
            stepped = verdict == GO_ON
            flows_known = flows_known or verdict == USE_CURRENTS
        return end, steps, largest

    def _step(self, flows_known: bool) -> tuple[float, float, float, bool]:
        """J at the state to which the feeders move first; max |dva| and |dvm| of the step from there, and if finite."""
        from dsse_core.radial import feeders, kernel

        plan, fork = self.plan, self.fork
        v, va, z, w, above, factor, more, step, block = self._views
        tree = plan.parent, plan.level, plan.admittance, z, w, v, va, flows_known

        def up(k: int, span: Span) -> float:
            J: float = feeders.go_up(
                *span, fork, *tree, self.share, self.dva, self.above[k], factor, more, step, self.to_fork[k]
            )
            return J

        def down(_: int, span: Span) -> tuple[float, float, bool]:
            largest: tuple[float, float, bool] = kernel.substitute_below(*span, plan.parent, factor, v, step, 0.0, 0.0)
            return largest

        J = sum(self._spread(up, self.spans))
        self.share = 0.0
        of_trunk, *largest = feeders.pass_trunk(fork, *tree, above, factor, more, block, step, self.to_fork)
        dva, dvm, finite = zip(largest, *self._spread(down, self.spans), strict=True)
        return J + of_trunk, max(dva), max(dvm), all(finite)

    def _move_trunk(self) -> None:
        from dsse_core.radial.iteration import move

        v, va, *_, step, _block = self._views
        here = slice(0, self.fork + 1)
        move(v[here], va[here], step[here], self.share, self.dva)

    def finish(self, state: np.ndarray, residual: np.ndarray) -> float:
        """Fills ``state`` (2, n_bus) and ``residual`` (n_meas,); returns J."""
        from dsse_core.radial import iteration

        plan, fork = self.plan, self.fork
        v, va, h, *_, step, _block = self._views

        def read(_: int, span: Span) -> None:
            here, rows = slice(*span), plan.order[slice(*span)]
            if self.share > 0.0 and span[0] > fork:
                iteration.move(v[here], va[here], step[here], self.share, self.dva)
            iteration.predict_part(*span, plan.parent, plan.admittance, v, va, plan.has_currents, h)
            state[0, rows], state[1, rows] = h[here, 1], va[here]

        def subtract(_: int, span: Span) -> float:
            here = slice(*span)
            J: float = iteration.subtract(plan.slot[here], self.values[here], self.sigmas[here], h, residual[here])
            return J

        read(0, (0, fork + 1))
        self._spread(read, self.spans)
        heads = fork + 1 + np.flatnonzero(plan.parent[fork + 1 :] == fork)
        h[fork, 2:4] += h[heads, 4:6].sum(axis=0)
        return float(sum(self._spread(subtract, self._meters)))


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
) -> Ended:
    """``iteration.estimate`` on ``threads`` threads: fills the same arrays and returns the same numbers."""
    from dsse_core.radial.feeders import find_feeders
    from dsse_core.radial.iteration import UNUSABLE

    with ThreadPoolExecutor(threads) as pool:
        fork, spans = find_feeders(plan.parent, threads)
        iteration = FeederIteration(plan, pool, fork, spans, exact, values, sigmas, space)
        if not iteration.begin(start, start_va):
            return UNUSABLE, 0, np.inf, np.inf
        end, steps, largest = iteration.iterate(tolerance, most_steps, limit)
        return end, steps, largest, iteration.finish(state, residual)
