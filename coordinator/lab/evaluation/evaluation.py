"""Steps shared by runs of processes and on the simulator: preparation, observation, evaluation."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path

from agents.strategies.installed import list_strategies, load_strategy
from coordinator.lab.evaluation.comparison import compare
from coordinator.lab.evaluation.result import RunOutcome, make_area_results
from coordinator.lab.evaluation.verdict import make_verdict
from coordinator.watch.observe.causes import Cause, find_causes
from coordinator.watch.observe.duplicates import Duplicate
from coordinator.watch.observe.grid_tables import GridTables, find_tables
from coordinator.watch.observe.observer import Observer
from coordinator.watch.observe.summary import summarise
from coordinator.watch.observe.switches import find_statuses
from dsse_core.code_places import has_whole
from dsse_core.errors import DsseError, InvalidInputError
from dsse_core.estimation.bad_data import BadDataReport, process_bad_data, process_bad_data_with_plan
from dsse_core.estimation.plan import EstimationPlan
from dsse_core.files.wording import describe_unknown
from dsse_core.grid.columns import read_column
from dsse_core.grid.meter_table import read_meters_of
from dsse_core.grid.switches import take_fed
from dsse_core.limits import LARGEST_SEED, LONGEST_S
from scenarios.faults.faults import LinkChanges, change_links
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import Telemetry

NO_CHANGES: LinkChanges = {}
NO_SETTINGS: Mapping[str, object] = {}
MAX_NAMED = 20  # obstacles
REFERENCE_ESTIMATE = 1e-9  # p.u. and rad: largest last step of a reference estimate


def choose_scenario(
    scenario: str | Path | Scenario,
    seed: int | None = None,
    strategy: str | None = None,
    timeout_s: float | None = None,
    links: LinkChanges = NO_CHANGES,
    changes: Mapping[str, object] = NO_SETTINGS,
) -> Scenario:
    """Load a scenario by name or path, and replace the values given; it may be impossible to estimate.

    ``changes``: key of the scenario file -> value in its place, for a scenario that is not loaded yet.

    Raises:
        InvalidInputError: every problem found.
    """
    if isinstance(scenario, Scenario):
        if changes:
            problem = f"{', '.join(changes)}: it is loaded already; give the changes to load_scenario"
            raise InvalidInputError(f"scenario {scenario.name!r}", [problem])
    else:
        scenario = load_scenario(scenario, strategies=list_strategies(), changes=changes)
    if seed is not None:
        if not (isinstance(seed, Integral) and 0 <= seed <= LARGEST_SEED):
            raise InvalidInputError("seed", [f"must be an integer from 0 to {LARGEST_SEED}"])
        scenario = replace(scenario, seed=seed)
    if strategy is not None:
        if strategy not in (known := list_strategies()):
            problem = f"strategy: {describe_unknown('strategy', strategy, known)}"
            raise InvalidInputError(f"scenario {scenario.name!r}", [problem])
        scenario = replace(scenario, strategy=strategy)
    if timeout_s is not None:
        if not 0 < timeout_s <= LONGEST_S:
            raise InvalidInputError("time limit", [f"is {timeout_s} s; it must be positive and at most {LONGEST_S} s"])
        scenario = replace(scenario, run=scenario.run.model_copy(update={"timeout_s": timeout_s}))
    return replace(scenario, faults=change_links(scenario.faults, links)) if links else scenario


def make_observer(scenario: Scenario, run: str) -> Observer:
    """An observer of run ``run`` with the tolerances and the heartbeat of ``scenario``."""
    return Observer(
        run,
        scenario.partition,
        tolerance_va=scenario.tolerances.consensus_va_rad,
        tolerance_vm=scenario.tolerances.consensus_vm_pu,
        heartbeat_s=scenario.run.beat_s,
        compare_magnitudes=load_strategy(scenario.strategy).reconciles_magnitudes,
    )


@dataclass(frozen=True, slots=True)
class Centralised:
    """The centralised estimate, or the reason of its failure; the areas continue without it."""

    report: BadDataReport | None
    failure: str | None


def estimate_centralised(scenario: Scenario, telemetry: Telemetry, plan: EstimationPlan | None = None) -> Centralised:
    """Estimate of a control centre from the telemetry of all areas, of the part of the grid that has supply.

    ``plan``: of all meters, if it exists already.

    Where the plan's solver is compiled, the other functions of a single estimate are compiled as well, since
    ``dsse estimate`` never waits for a compiler.
    """
    readings, tolerance = telemetry.union, min(scenario.tolerances.estimator, REFERENCE_ESTIMATE)
    try:
        if plan is not None and plan.meters is read_meters_of(readings):  # each meter has a reading
            values, sigmas = (read_column(readings, key, float) for key in ("value", "sigma"))
            report = process_bad_data_with_plan(plan, values, sigmas, tolerance=tolerance)
        else:
            report = process_bad_data(*take_fed(scenario.network, readings), tolerance=tolerance)
    except DsseError as error:
        return Centralised(None, str(error))
    except MemoryError as error:  # areas, each with a part of the grid, may have enough memory
        return Centralised(None, ": ".join(filter(None, ["there is not enough memory for it", str(error)])))
    plan = report.result.plan
    if plan.backend == "radial" and not has_whole("estimate"):
        from agents.runtime.warm_up import warm_up_estimate  # not needed by most runs

        warm_up_estimate()
    if plan.backend == "sparse" and plan.sparse.is_compiled and not has_whole("sparse"):
        from agents.runtime.warm_up import warm_up_sparse

        warm_up_sparse()
    return Centralised(report, None)


def no_consensus_within(scenario: Scenario, obstacles: tuple[str, ...]) -> str:
    """The reason of a run that has reached its time limit."""
    more = [f"and {len(obstacles) - MAX_NAMED} more"] if len(obstacles) > MAX_NAMED else []
    return f"no consensus within {scenario.run.timeout_s:g} s: " + "; ".join([*obstacles[:MAX_NAMED], *more])


def evaluate(
    scenario: Scenario,
    run: str,
    observer: Observer,
    telemetry: Telemetry,
    centralised: Centralised,
    reason: str | None,
    *,
    started: float,
    wall_s: float,
    virtual_s: float | None,
    timing_s: Mapping[str, float],
    faults: Mapping[str, int],
    duplicates: Sequence[Duplicate] = (),
) -> RunOutcome:
    """Compare the areas' published states with the centralised estimate and the truth; the outcome of the run.

    Switches are as the areas have published them. ``reason``: None at consensus. ``started``: start of the run on the
    observer's clock, s. ``faults``: kind -> number of faults. ``duplicates``: areas, plants and gateways that ran
    twice.
    """
    scenario = scenario.operated(find_statuses(scenario.partition, observer.states))
    comparison = compare(scenario.partition, observer.states, telemetry.truth, centralised.report)
    now = started + (wall_s if virtual_s is None else virtual_s)
    shown_at = now if virtual_s is not None else time.time() - (time.monotonic() - now)
    return RunOutcome(
        scenario=scenario,
        run=run,
        verdict=make_verdict(observer, comparison, reason, wall_s, virtual_s),
        area_results=make_area_results(observer, comparison, now),
        comparison=comparison,
        centralised=centralised.report,
        centralised_failure=centralised.failure,
        history=tuple(replace(sample, time=sample.time - started) for sample in observer.history),
        timing_s=timing_s,
        faults=faults,
        duplicates=tuple(duplicates),
        readings=telemetry.union,
        causes=_find_causes(scenario, observer, now, shown_at),
    )


def _find_causes(scenario: Scenario, observer: Observer, now: float, shown_at: float) -> tuple[Cause, ...]:
    """Root causes at time ``now`` of the observer's clock."""
    view, known = observer.watcher.look(now), GridTables(scenario)
    summary = summarise(find_tables(observer.watcher, view, known), known)
    return find_causes(view, shown_at, summary, with_magnitudes=observer.compare_magnitudes)


def start_reference_estimate(estimate: Callable[[], Centralised]) -> Future[Centralised]:
    """Make the centralised estimate on a daemon thread, which does not delay the end of the program."""
    future: Future[Centralised] = Future()

    def make() -> None:
        try:
            future.set_result(estimate())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=make, name="centralised estimate", daemon=True).start()
    return future
