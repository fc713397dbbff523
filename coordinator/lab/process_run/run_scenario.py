"""One run from the scenario to its verdict: start the processes, watch them, compare, write the files."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

from agents.messages.keys import default_run_id
from agents.security.access import COORDINATOR, PLANT
from agents.security.credential_files import AUTHORITY, credentials_in
from agents.strategies.installed import load_strategy
from coordinator.lab.evaluation.evaluation import (
    Centralised,
    choose_scenario,
    estimate_centralised,
    evaluate,
    make_observer,
    no_consensus_within,
    start_reference_estimate,
)
from coordinator.lab.evaluation.result import RunResult, write_files
from coordinator.lab.plant.plant import RESUME, SILENT
from coordinator.lab.plant.telemetry_messages import DRAW
from coordinator.lab.process_run.compile_clock import clock
from coordinator.lab.process_run.processes import Launcher, LaunchError
from coordinator.lab.process_run.run_keys import folder_of_keys
from coordinator.lab.process_run.run_status import (
    RunUnderWay,
    listen,
    listen_to_processes,
    note_duplicates,
    note_ends,
    take_process_update,
    take_update,
)
from coordinator.lab.process_run.system import System
from coordinator.lab.strategy_check import plan_with_strategy
from coordinator.watch.observe.event_log import EventLog
from coordinator.watch.observe.observer import Observer
from coordinator.watch.observe.progress import UPDATE_S, Progress, describe_progress
from coordinator.watch.observe.switches import find_statuses
from coordinator.watch.run_folder import EVENTS, PARTS, RECORDING, make_run_folder
from dsse_core.estimation.plan import FEWEST_BUSES_OF_RADIAL
from dsse_core.linear import needs_compiled_code
from scenarios.faults.schedule import SWITCHING, Step
from scenarios.faults.switching import find_next, find_operated
from scenarios.scenario import Scenario
from scenarios.telemetry import Telemetry, expect_telemetry, make_telemetry

DAYS_OF_A_RUN = 1.0  # that the keys of one secured run are valid
# From this number of areas on, the parent of all processes rehearses, and the areas have cores and memory to
# themselves: readings are made when all agents are on the bus, and the centralised estimate after the verdict.
MANY_AREAS = 50
JOIN_SHARE = 0.25  # or after this part of the time limit
LOOK_SHARE = 0.05  # of the time of watching that checks may take; hundreds of areas need the cores
INTERRUPTED = "interrupted"


def run_scenario(
    launcher: Launcher,
    scenario: str | Path | Scenario,
    started: float,
    out: str | Path | None = None,
    seed: int | None = None,
    strategy: str | None = None,
    timeout_s: float | None = None,
    on_update: Callable[[Progress], None] | None = None,
    secure: bool = False,
    keys: str | Path | None = None,
) -> RunResult:
    """Runs ``scenario`` with the processes of ``launcher``; see ``coordinator.run``. ``started``: monotonic time."""
    scenario = choose_scenario(scenario, seed, strategy, timeout_s)
    _preload(launcher, scenario)  # beside the check, which in a large grid takes as long
    plan = plan_with_strategy(scenario)
    folder = make_run_folder(out, default_run_id(scenario.name), PARTS)
    with ExitStack() as at_the_end, EventLog(folder / EVENTS, started) as events:
        run_id = f"{default_run_id(scenario.name)}-{secrets.token_hex(4)}"
        keys = _find_keys(scenario, run_id, launcher.mark, at_the_end, secure, keys)
        system = System(launcher, scenario, run_id, folder, keys=keys)
        system.scan_every_s = scenario.renew_s
        run = RunUnderWay(scenario, run_id, folder, system, events, started, plan)
        parent = {"parent_pid": launcher.pid, "mark": launcher.mark}
        events.write("run started", None, run=run_id, scenario=scenario.name, seed=scenario.seed, **parent)
        if events.failure:  # `dsse stop` finds the processes by this event: without it, no process is started
            raise LaunchError(f"{events.failure}; no process is started; choose another place, or make room there")
        listen_to_processes(run)
        run.note_time("scenario_loaded")
        try:
            run.system.start_bus(lambda: _wait_for_router(run))
            run.note_time("router_listens")
            if scenario.record is not None:
                run.system.start_recorder(folder / RECORDING, scenario.record.limit_gb, lambda: _wait_for_router(run))
            return _run_with_router(run, on_update)
        finally:
            launcher.close()
            note_ends(run)
            events.write("run ended")
            if scenario.record is not None:
                from coordinator.watch.recording.closing import close_recording  # which most runs do not need

                close_recording(folder / RECORDING)


def _preload(launcher: Launcher, scenario: Scenario) -> None:
    """Has the parent of all processes import the strategy and its solvers and, for many areas, rehearse an estimate."""
    launcher.preload("agents.strategies.installed:list_strategies", load_strategy(scenario.strategy).__module__)
    launcher.preload(*_find_solvers(scenario))
    if len(scenario.partition.areas) >= MANY_AREAS:
        largest = max(len(area.network.buses) for area in scenario.partition.areas)
        launcher.preload("coordinator.lab.process_run.rehearsal:rehearse", arguments=(scenario.strategy, largest))


def _find_solvers(scenario: Scenario) -> tuple[str, ...]:
    """Compiled solvers that the areas need, as targets of ``Launcher.preload``."""
    areas = scenario.partition.areas
    exchange = any(needs_compiled_code(area) for area in areas)
    largest = max((len(area.network.buses) for area in areas), default=0)
    estimate = load_strategy(scenario.strategy).estimates_alone and largest >= FEWEST_BUSES_OF_RADIAL
    return ("agents.runtime.warm_up:warm_up",) * exchange + ("agents.runtime.warm_up:warm_up_estimate",) * (
        exchange and estimate
    )


def _find_keys(
    scenario: Scenario, run_id: str, mark: str, at_the_end: ExitStack, secure: bool, keys: str | Path | None
) -> Path | None:
    """The folder of credentials of a secured run, made for this run if none is given; None if the run is not secured.

    Credentials made here are secret: they are no part of the result, and are removed ``at_the_end``.
    """
    if keys is None and not secure:
        return None
    from agents.security.access import access_of
    from coordinator.lab.deployment.certificates import check_keys, create_keys  # not needed by most runs

    access = access_of(scenario.partition, run_id, scenario.reading_rules)
    direct = scenario.transport.kind == "neighbours"
    if keys is not None:
        check_keys(Path(keys), access, direct)
        return Path(keys).absolute()
    host = scenario.transport.listen.partition("/")[2].rpartition(":")[0]
    folder = at_the_end.enter_context(folder_of_keys(mark))
    create_keys(folder, access, DAYS_OF_A_RUN, [host.strip("[]")], direct=direct)
    credentials_in(folder, AUTHORITY).key.unlink()  # no certificate can be issued later
    return folder


def _wait_for_router(run: RunUnderWay) -> str | None:
    """Waits a moment for updates. Returns the reason to give up if a process has ended, else None."""
    for item in run.updates.take(0.002):
        reason = take_process_update(run, item)
        if reason:
            return reason
    return None


def _run_with_router(run: RunUnderWay, on_update: Callable[[Progress], None] | None) -> RunResult:
    scenario = run.scenario
    run.system.start_agents()
    run.note_time("agents_started")
    observer = make_observer(scenario, run.id)
    with run.system.join(COORDINATOR) as session:
        listen(run, session)
        reason = None
        has_many = len(scenario.partition.areas) >= MANY_AREAS
        if has_many:
            reason = _watch(run, observer, on_update, is_over=lambda: _is_time_to_begin(run))
        telemetry = expect_telemetry(scenario)  # of fewer areas made while they join
        if reason is None and scenario.telemetry.source != "live":
            run.note_time("plant_started")
            is_only = scenario.renew_s is None and find_next(scenario.faults.events, -1.0) is None
            run.system.start_plant(telemetry if is_only else None)
        telemetry = _keep_compared(telemetry)
        beside = None if has_many else start_reference_estimate(lambda: _estimate_centralised(run, scenario, telemetry))
        reason = reason or _watch(run, observer, on_update)
        made, telemetry = telemetry, _find_telemetry(run, telemetry)
        used = run.used.put_into(telemetry, observer.states)
        operated = scenario.operated(find_statuses(scenario.partition, observer.states))
        wall_s = time.monotonic() - run.started
    run.timing_s["last_change"] = max(0.0, observer.changed_at - run.started)
    run.note_time("verdict")
    run.events.write("consensus" if reason is None else "no consensus", reason=reason)
    run.system.launcher.stop()  # the processes end while the files are written
    is_made = used is made and operated is scenario
    centralised = _find_centralised(run, operated, used, beside if is_made else None)
    outcome = evaluate(
        scenario,
        run.id,
        observer,
        used,
        centralised,
        reason,
        started=run.started,
        wall_s=wall_s,
        virtual_s=None,
        timing_s=run.timing_s,
        faults=run.states.faults + run.schedule.counts,
        duplicates=run.duplicates.found,
    )
    result = write_files(outcome.in_folder(run.folder), run.events.failure)
    if INTERRUPTED in (reason, centralised.failure):
        raise KeyboardInterrupt
    return result


def _find_telemetry(run: RunUnderWay, made: Telemetry) -> Telemetry:
    """The telemetry by the switches as events have operated them by now; ``made``: that of the start."""
    events, elapsed_s = run.scenario.faults.events, time.monotonic() - (run.joined or math.inf)
    closed = find_operated(events, run.scenario.network.switches, elapsed_s).closed
    if closed.items() <= run.scenario.network.switches.items():
        return made
    return _keep_compared(make_telemetry(run.scenario, DRAW, closed))


def _keep_compared(telemetry: Telemetry) -> Telemetry:
    """``telemetry`` without the readings of each area, which the plant has now, and without the admittances of the
    truth, which were made for these readings.
    """
    truth = telemetry.truth and replace(telemetry.truth)  # the copy has no admittances, the largest part of the memory
    return replace(telemetry, by_area={}, truth=truth)


def _find_centralised(
    run: RunUnderWay, scenario: Scenario, telemetry: Telemetry, beside: Future[Centralised] | None
) -> Centralised:
    """The centralised estimate of ``telemetry``, from ``beside`` if it is computed there. Ctrl-C ends the wait for the
    estimate; the results of the areas are still written.
    """
    try:
        return beside.result() if beside else _estimate_centralised(run, scenario, telemetry)
    except KeyboardInterrupt:
        return Centralised(None, INTERRUPTED)


def _estimate_centralised(run: RunUnderWay, scenario: Scenario, telemetry: Telemetry) -> Centralised:
    """The centralised estimate of ``scenario``: the run's, or the same with other switches."""
    found = estimate_centralised(scenario, telemetry, run.plan if scenario is run.scenario else None)
    run.note_time("centralised_estimated")
    return found


def _is_time_to_begin(run: RunUnderWay) -> bool:
    waited_s = time.monotonic() - clock.find_start(run.started)
    return run.joined is not None or waited_s >= JOIN_SHARE * run.scenario.run.timeout_s


def _watch(
    run: RunUnderWay,
    observer: Observer,
    on_update: Callable[[Progress], None] | None,
    is_over: Callable[[], bool] = lambda: False,
) -> str | None:
    """Takes in updates until there is consensus, or ``is_over`` holds, and returns None. Returns the reason if the run
    ends before: a process has died, an area cannot become good, the time limit has passed, or Ctrl-C.

    ``is_over``: called after every batch of updates, so it must be cheap.
    """
    check_s = min(run.scenario.run.beat_s / 10, UPDATE_S)
    next_check = next_update = 0.0
    try:
        while True:
            for item in run.updates.take(check_s):
                reason = take_update(run, observer, item)
                if reason:
                    return reason
            now = time.monotonic()
            note_duplicates(run, run.duplicates.find_lasting(now), now)
            _carry_out_faults(run, observer, now)
            if is_over():
                return None
            if now < next_check:
                continue
            standing = observer.standing(now)
            obstacles = (*run.schedule.describe_obstacles(), *standing.obstacles)
            obstacles = obstacles or tuple(run.used.find_missing(observer.states))
            if on_update and (now >= next_update or not obstacles):
                next_update = now + UPDATE_S
                on_update(describe_progress(observer, now - run.started, standing.obstacles))
            next_check = now + max(check_s, (time.monotonic() - now) / LOOK_SHARE)
            if not obstacles:
                return None
            if not run.schedule.steps and standing.dead_end:
                return standing.dead_end
            if now >= clock.find_start(run.started) + run.scenario.run.timeout_s:
                return no_consensus_within(run.scenario, obstacles)
    except KeyboardInterrupt:
        return INTERRUPTED


def _carry_out_faults(run: RunUnderWay, observer: Observer, now: float) -> None:
    """Carries out the steps of the fault schedule that are due, and writes an event for each. Publishes the clock of
    the run, by which the agents time the faults of their links.
    """
    if run.joined is not None:
        run.clock.tick(now - run.joined)
        for step in run.schedule.carry_out(now - run.joined, partial(do_to_processes, run.system)):
            run.events.write("fault", kind=step.kind, names=step.names)
            observer.take_fault(now)
            if step.kind in SWITCHING:
                run.used.operated_at = time.time()


def do_to_processes(system: System, step: Step) -> None:
    """Carries out one step on the processes of ``system``. Steps of links do nothing here."""
    name = step.names[0]
    match step.kind:
        case "kill":
            system.kill(name)
        case "restart":
            system.restart(name)
        case "pause":
            system.pause(name)
        case "resume":
            system.go_on(name)
        case "silent":
            system.launcher.signal(PLANT, SILENT)
        case "speak":
            system.launcher.signal(PLANT, RESUME)
        case _:
            pass  # by the times in area files and scenario, agents cut and heal links, and the plant operates switches
