"""Power flow and estimates of one network: for each start and set of meters the iterations, or a reason of failure."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from time import process_time
from typing import Any

import numpy as np

from dsse_core.errors import DsseError
from dsse_core.estimation.estimator import estimate_with_plan
from dsse_core.estimation.plan import EstimationPlan, build_estimation_plan
from dsse_core.estimation.result import EstimationResult
from dsse_core.grid.network import Network
from dsse_core.power_flow.exact_readings import read_exactly
from dsse_core.power_flow.newton_raphson import PowerFlowResult, solve_with_plan
from dsse_core.power_flow.plan import PowerFlowPlan, build_power_flow_plan
from scenarios.files.scenario_file import MeasurementsTable
from scenarios.meters import build_meters, build_sigma_rule

TOLERANCE = 1e-10  # of power flows, p.u.
MOST_ITERATIONS = 30
LEVEL_BEFORE = 0.9  # of all loads and sources, in the state that warm starts begin at
SAME_MINIMUM = 1e-6  # relative difference of J
VOLTAGE, FLOW, INJECTION = {"sigma_percent": 0.3}, {"sigma_percent": 1.0}, {"sigma_percent": 10.0}
SCHEDULE = {"sigma_percent": 30.0}

Table = dict[str, Any]
Start = tuple[np.ndarray, np.ndarray]


def _everywhere(of: Table, places: str = "buses") -> Table:
    return {**of, places: "all"}


def _choose(network: Network, share: float) -> list[int]:
    """The substation and a ``share`` of the other buses, evenly in the order of the file."""
    assert network.slack is not None  # importers refuse a network without
    others = [bus.id for bus in network.buses if bus.id != network.slack.bus]
    step = max(1, round(1 / share))
    return [network.slack.bus, *others[step - 1 :: step]]


def _choose_heads(network: Network, share: float) -> list[str]:
    """The branches at the substation and a ``share`` of the others."""
    assert network.slack is not None
    active, step = network.active_branches, max(1, round(1 / share))
    heads = [b.id for b in active if network.slack.bus in (b.from_bus, b.to_bus)]
    return list(dict.fromkeys([*heads, *(branch.id for branch in active[step - 1 :: step])]))


SETS: Mapping[str, Callable[[Network], Table]] = {
    "import": lambda network: {
        "voltage": {"buses": _choose(network, 1e-9), "sigma_percent": 0.2},
        "flow": _everywhere(FLOW, "branches"),
        "injection": _everywhere(INJECTION),
    },
    "rich": lambda network: {
        "voltage": _everywhere(VOLTAGE),
        "flow": _everywhere(FLOW, "branches"),
        "injection": _everywhere({"sigma_percent": 3.0}),
    },
    "schedules": lambda network: {
        "voltage": {"buses": _choose(network, 0.05), **VOLTAGE},
        "flow": {"branches": _choose_heads(network, 0.02), **FLOW},
        "injection": _everywhere(SCHEDULE),
    },
    "currents": lambda network: {
        "voltage": {"buses": _choose(network, 0.1), **VOLTAGE},
        "current": _everywhere(FLOW, "branches"),
        "injection": _everywhere(INJECTION),
    },
    "angles": lambda network: {
        "voltage": {"buses": _choose(network, 0.1), **VOLTAGE},
        "angle": {"buses": _choose(network, 0.1), "sigma_deg": 0.05},
        "flow": {"branches": _choose_heads(network, 0.3), **FLOW},
        "injection": _everywhere(INJECTION),
    },
}
"""Name -> the table ``[measurements]`` of a scenario. ``import``: what ``dsse import`` writes."""


@dataclass(frozen=True)
class Trial:
    """End of one solution: ``iterations``, or the reason of its ``failure``, empty with a solution."""

    iterations: int = 0
    failure: str = ""
    is_left_out: bool = False

    def __str__(self) -> str:
        return "" if self.is_left_out else "**no**" if self.failure else str(self.iterations)


@dataclass(frozen=True)
class Limits:
    """``most_buses`` of a network that is estimated; ``limit_s`` of processor time for its estimates."""

    most_buses: int
    limit_s: float


@dataclass(frozen=True)
class CaseTrials:
    """All trials of one network: ``flows`` by start, ``estimates`` by set of meters and start."""

    n_bus: int
    n_branch: int
    flows: Mapping[str, Trial] = field(default_factory=dict)
    estimates: Mapping[tuple[str, str], Trial] = field(default_factory=dict)


def try_network(network: Network, limits: Limits) -> CaseTrials:
    """Solve and estimate ``network`` from all starts."""
    size = len(network.buses), len(network.active_branches)
    plan = build_power_flow_plan(network)
    before = _solve(plan, LEVEL_BEFORE)
    cold = _solve(plan, 1.0)
    flows = {"cold": _describe(cold)}
    if isinstance(before, PowerFlowResult):
        warm = _solve(replace(plan, start=np.r_[before.va, before.vm]), 1.0)
        flows["warm"] = _describe(warm)
        cold = cold if isinstance(cold, PowerFlowResult) else warm
    if not isinstance(cold, PowerFlowResult):
        return CaseTrials(*size, flows)
    if size[0] > limits.most_buses:
        return CaseTrials(*size, flows)
    start = (before.vm, before.va) if isinstance(before, PowerFlowResult) else None
    return CaseTrials(*size, flows, dict(_try_sets(network, cold, start, process_time() + limits.limit_s)))


def _solve(plan: PowerFlowPlan, level: float) -> PowerFlowResult | DsseError:
    scheduled = level * plan.network.scheduled
    try:
        return solve_with_plan(plan, scheduled, plan.find_limit(TOLERANCE), MOST_ITERATIONS)
    except DsseError as error:
        return error


def _describe(found: PowerFlowResult | EstimationResult | DsseError) -> Trial:
    return Trial(failure=str(found)) if isinstance(found, DsseError) else Trial(found.iterations)


def _try_sets(
    network: Network, truth: PowerFlowResult, before: Start | None, until: float
) -> Iterator[tuple[tuple[str, str], Trial]]:
    """The trial of each set of meters and start, until the processor time is ``until``; later sets are left out."""
    starts: dict[str, Start | None] = {"flat": None} | ({"warm": before} if before else {})
    for name, make in SETS.items():
        if process_time() > until:
            yield from (((name, key), Trial(is_left_out=True)) for key in starts)
            continue
        try:
            plan, values, sigmas = _read(network, truth, MeasurementsTable.model_validate(make(network)))
        except DsseError as error:
            yield from (((name, key), Trial(failure=str(error))) for key in starts)
            continue
        found = {key: _estimate(plan, values, sigmas, start) for key, start in starts.items()}
        least = min((f.objective for f in found.values() if isinstance(f, EstimationResult)), default=0.0)
        for key, end in found.items():
            trial = _describe(end)
            if isinstance(end, EstimationResult) and end.objective > least + SAME_MINIMUM * max(least, 1.0):
                trial = Trial(failure=f"another minimum: J = {end.objective:.6g}, from the other start {least:.6g}")
            yield (name, key), trial


def _read(
    network: Network, truth: PowerFlowResult, table: MeasurementsTable
) -> tuple[EstimationPlan, np.ndarray, np.ndarray]:
    """Plan of the meters of ``table``, their readings with noise, and their standard deviations."""
    meters = build_meters(table, network)
    exact, size = read_exactly(truth, meters)
    sigmas = build_sigma_rule(table, network).sigmas(meters, size)
    noise = np.random.default_rng(zlib.crc32(network.name.encode())).standard_normal(len(meters))
    values = np.where(sigmas > 0, exact + noise * sigmas, 0.0)
    return build_estimation_plan(network, meters), values, sigmas


def _estimate(
    plan: EstimationPlan, values: np.ndarray, sigmas: np.ndarray, start: Start | None
) -> EstimationResult | DsseError:
    try:
        return estimate_with_plan(plan, values, sigmas, start=start)
    except DsseError as error:
        return error
