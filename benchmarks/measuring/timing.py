"""Work of one child process: a method timed in turn with ours, or tried on random draws."""

from __future__ import annotations

import gc
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import numpy as np

from benchmarks.estimates.cases import Case, build_case
from benchmarks.methods.method import Method, NotConvergedError, State
from dsse_core.grid.network import Network

FEWEST_RUNS = 3


@dataclass(frozen=True)
class Timing:
    """Medians of ``runs`` runs."""

    cold_ms: float
    warm_ms: float
    runs: int


@dataclass(frozen=True)
class Outcome:
    """A method on a case: its median times, those of ours in the same runs, and its result.

    ``difference`` is max |V - V of ours|, complex, p.u.
    """

    timing: Timing
    ours: dict[str, Timing]
    objective: float
    iterations: int | None
    difference: float | None


@dataclass(frozen=True)
class Draws:
    """``objective`` of each draw, None where the method found no estimate; the ``reasons`` counted."""

    objective: list[float | None] = field(default_factory=list)
    reasons: dict[str, int] = field(default_factory=dict)


def measure(case: Case, method: Method, ours: Sequence[Method], runs: int, budget_s: float) -> Outcome:
    """Time ``method`` and every one of ``ours`` in turn, after one run of each that is not counted.

    Ends after ``runs`` runs, or sooner, after FEWEST_RUNS, when ``budget_s`` is used up. An error of ``method`` is
    raised; a method of ours that fails is left out.
    """
    methods = {one.name: one for one in (*ours, method)}
    states: dict[str, State] = {}
    data: dict[str, Any] = {}
    for name, one in methods.items():
        try:
            data[name] = one.translate(case)
            states[name] = _read_finite(one, case, one.solve(one.build(data[name])))
        except Exception:
            if name == method.name:
                raise
    cold: dict[str, list[float]] = {name: [] for name in states}
    warm: dict[str, list[float]] = {name: [] for name in states}
    end = time.perf_counter() + budget_s
    run = 0
    while run < runs and (run < FEWEST_RUNS or time.perf_counter() < end):
        for name in states:
            for times, elapsed in zip((cold, warm), _time_cold_and_warm(methods[name], data[name]), strict=True):
                times[name].append(elapsed)
        run += 1
    timings = {name: Timing(1e3 * median(cold[name]), 1e3 * median(warm[name]), run) for name in cold}
    state = states[method.name]
    first = next((states[one.name] for one in ours if one.name in states), None)
    return Outcome(
        timing=timings[method.name],
        ours={one.name: timings[one.name] for one in ours if one.name in timings},
        objective=case.objective(state.vm, state.va),
        iterations=state.iterations,
        difference=None if first is None else float(abs(_phasors(state) - _phasors(first)).max()),
    )


def try_draws(network: Network, set_name: str, method: Method, draws: int, budget_s: float) -> Draws:
    """The method on the random draws 0 to ``draws`` - 1; fewer when ``budget_s`` is used up."""
    objective: list[float | None] = []
    reasons: Counter[str] = Counter()
    end = time.perf_counter() + budget_s
    for draw in range(draws):
        if time.perf_counter() > end:
            break
        case = build_case(network, set_name, draw)
        try:
            state = _read_finite(method, case, method.solve(method.build(method.translate(case))))
        except Exception as error:  # whatever the tool calls it, it found no estimate
            objective.append(None)
            reasons[type(error).__name__] += 1
        else:
            objective.append(case.objective(state.vm, state.va))
    return Draws(objective, dict(reasons))


def _time_cold_and_warm(method: Method, data: Any) -> tuple[float, float]:
    """Seconds to build and solve, and to solve again."""
    gc.collect()
    start = time.perf_counter()
    model = method.build(data)
    method.solve(model)
    built_and_solved = time.perf_counter()
    gc.collect()
    again = time.perf_counter()
    method.solve(model)
    return built_and_solved - start, time.perf_counter() - again


def _read_finite(method: Method, case: Case, result: Any) -> State:
    """The state in ``result``, whatever success the tool reports.

    Raises:
        NotConvergedError: a voltage is not finite.
    """
    state = method.read(case, result)
    if not (np.isfinite(state.vm).all() and np.isfinite(state.va).all()):
        raise NotConvergedError("voltages that are not finite")
    return state


def _phasors(state: State) -> np.ndarray:
    return np.asarray(state.vm * np.exp(1j * state.va))
