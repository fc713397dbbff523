"""All cases against all methods, one row each; a failure is a row with its reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from benchmarks.estimates.batch import BatchRow, measure_batches
from benchmarks.estimates.cases import SHARP, build_case, build_network
from benchmarks.measuring.limits import LimitedCallError, call_limited
from benchmarks.measuring.machine import find_version
from benchmarks.measuring.timing import Draws, Outcome, measure, try_draws
from benchmarks.methods.method import Method

Answer = TypeVar("Answer")
SAME_MINIMUM = 1e-6  # relative, of J; the tools' tolerances of 1e-6 on the step leave some 1e-10
MOST_BUSES_OF_DRAWS = 10_000


@dataclass(frozen=True)
class Limits:
    """Limits of one case with one method: those of its process, and the time that repeated runs may use."""

    runs: int
    seconds: float
    gib: float

    @property
    def budget_s(self) -> float:
        return self.seconds / 5


@dataclass(frozen=True)
class Row:
    """One method on one case. ``ratios``: back end of ours -> (cold, warm), the method's time divided by ours.

    ``excess``: J relative to the lowest J that any method found, minus 1. ``remark``: reason for missing figures, or a
    note that the minimum is another one.
    """

    n_bus: int
    set_name: str
    method: str
    remark: str
    outcome: Outcome | None = None
    excess: float | None = None
    ratios: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class DrawRow:
    """Counts of random draws: ``tried``, with an estimate, and with an estimate at the lowest J of any method."""

    n_bus: int
    set_name: str
    method: str
    tried: int
    estimated: int
    at_minimum: int
    remark: str


def compare(
    sizes: Sequence[int],
    sets: Sequence[str],
    ours: Sequence[Method],
    others: Sequence[Method],
    limits: Limits,
    report: Callable[[str], None],
) -> list[Row]:
    """Every method on every network and measurement set."""
    rows = []
    for n_bus in sizes:
        network = build_network(n_bus)
        for set_name in sets:
            case = build_case(network, set_name)
            found: dict[str, Outcome | str] = {}
            for method in (*ours, *others):
                report(f"{n_bus} buses, {set_name}: {method.name}")
                found[method.name] = _try(method, limits, measure, case, method, ours, limits.runs, limits.budget_s)
            rows += _evaluate(n_bus, set_name, found)
    return rows


def compare_draws(
    sizes: Sequence[int],
    sets: Sequence[str],
    methods: Sequence[Method],
    draws: int,
    limits: Limits,
    report: Callable[[str], None],
) -> list[DrawRow]:
    """Every method on the same random draws, sigma floor 200 VA; of networks of at most MOST_BUSES_OF_DRAWS buses."""
    rows = []
    for n_bus in [n for n in sizes if n <= MOST_BUSES_OF_DRAWS] if draws else []:
        network = build_network(n_bus)
        for set_name in dict.fromkeys(name.removesuffix(SHARP) + SHARP for name in sets):
            found: dict[str, Draws | str] = {}
            for method in methods:
                report(f"{n_bus} buses, {set_name}, {draws} random draws: {method.name}")
                found[method.name] = _try(
                    method, limits, try_draws, network, set_name, method, draws, 0.8 * limits.seconds
                )
            rows += _count(n_bus, set_name, found)
    return rows


def compare_batches(
    sizes: Sequence[int], sets: Sequence[str], limits: Limits, report: Callable[[str], None]
) -> list[BatchRow]:
    """Batches of scans on networks of at most MOST_BUSES_OF_DRAWS buses; a batch that fails has no rows."""
    rows: list[BatchRow] = []
    for n_bus in [n for n in sizes if n <= MOST_BUSES_OF_DRAWS]:
        network = build_network(n_bus)
        for set_name in sets:
            report(f"{n_bus} buses, {set_name}: batches")
            case = build_case(network, set_name)
            try:
                rows += call_limited(
                    measure_batches, case, min(limits.runs, 7), limit_s=limits.seconds, limit_gib=limits.gib
                )
            except LimitedCallError as error:
                report(str(error))
    return rows


def _try(method: Method, limits: Limits, function: Callable[..., Answer], *args: object) -> Answer | str:
    """The answer; without any, the reason as text."""
    if find_version(method.package) is None:
        return f"not installed: pip install {method.package}"
    try:
        answer: Answer = call_limited(function, *args, limit_s=limits.seconds, limit_gib=limits.gib)
    except LimitedCallError as error:
        return str(error)
    return answer


def _evaluate(n_bus: int, set_name: str, found: dict[str, Outcome | str]) -> list[Row]:
    lowest = min((o.objective for o in found.values() if isinstance(o, Outcome)), default=0.0)
    rows = []
    for name, outcome in found.items():
        if isinstance(outcome, str):
            rows.append(Row(n_bus, set_name, name, outcome))
            continue
        excess = outcome.objective / lowest - 1
        ratios = {
            own: (outcome.timing.cold_ms / timing.cold_ms, outcome.timing.warm_ms / timing.warm_ms)
            for own, timing in outcome.ours.items()
        }
        remark = "" if excess < SAME_MINIMUM else f"not the minimum: J is {excess:.2g} higher"
        rows.append(Row(n_bus, set_name, name, remark, outcome, excess, ratios))
    return rows


def _count(n_bus: int, set_name: str, found: dict[str, Draws | str]) -> list[DrawRow]:
    lowest: dict[int, float] = {}
    for draws in found.values():
        for k, objective in enumerate(draws.objective if isinstance(draws, Draws) else ()):
            if objective is not None:
                lowest[k] = min(objective, lowest.get(k, objective))
    rows = []
    for name, draws in found.items():
        if isinstance(draws, str):
            rows.append(DrawRow(n_bus, set_name, name, 0, 0, 0, draws))
            continue
        estimates = {k: objective for k, objective in enumerate(draws.objective) if objective is not None}
        at_minimum = sum(objective < (1 + SAME_MINIMUM) * lowest[k] for k, objective in estimates.items())
        reasons = ", ".join(f"{count} {reason}" for reason, count in draws.reasons.items())
        rows.append(DrawRow(n_bus, set_name, name, len(draws.objective), len(estimates), at_minimum, reasons))
    return rows
