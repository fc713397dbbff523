"""One run of a scenario on the simulator, from the scenario to its verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from agents.messages.keys import default_run_id
from agents.messages.packing import ReadingsMessage, StateMessage
from agents.security.access import ROUTERS
from coordinator.lab.deployment.split import area_files
from coordinator.lab.evaluation.evaluation import (
    NO_CHANGES,
    choose_scenario,
    estimate_centralised,
    evaluate,
    make_observer,
    no_consensus_within,
)
from coordinator.lab.evaluation.result import RunOutcome, RunResult, write_files
from coordinator.lab.evaluation.used_readings import UsedReadings
from coordinator.lab.plant.held_readings import HeldReadings
from coordinator.lab.plant.telemetry_messages import DRAW
from coordinator.lab.simulator.simulator import STARTED_AT, SimulatedBus
from coordinator.lab.simulator.subscriber import SimulatedRecording, Subscriber
from coordinator.lab.strategy_check import check_with_strategy
from coordinator.watch.observe.event_log import EventLog
from coordinator.watch.observe.progress import UPDATE_S, Progress, describe_progress
from coordinator.watch.observe.state_log import StateLog
from coordinator.watch.observe.switches import find_statuses
from coordinator.watch.run_folder import RECORDING, make_run_folder
from scenarios.faults.faults import LinkChanges
from scenarios.faults.schedule import SWITCHING, FaultSchedule, Step
from scenarios.faults.switching import Operated, find_operated
from scenarios.scenario import Scenario
from scenarios.telemetry import find_lateness, make_telemetry

LEASE_S = 2.0  # after which processes leave a frozen router for the other one
NO_BUS = ("tcp/127.0.0.1:0",)  # endpoint in the area files
CHECKS_PER_HEARTBEAT_S = 10
FIRST_SCAN = 1


def simulate_scenario(
    scenario: str | Path | Scenario,
    out: str | Path | None = None,
    seed: int | None = None,
    strategy: str | None = None,
    timeout_s: float | None = None,
    on_update: Callable[[Progress], None] | None = None,
    links: LinkChanges = NO_CHANGES,
) -> RunResult:
    """Runs ``scenario`` on the simulator and writes the files of a run; see ``coordinator.simulate``."""
    scenario = check_with_strategy(choose_scenario(scenario, seed, strategy, timeout_s, links))
    folder = make_run_folder(out, default_run_id(scenario.name))
    with EventLog(folder / "events.jsonl", 0.0) as events:
        recording = _begin_recording(scenario, folder / RECORDING)
        simulation = Simulation(scenario, events, on_update, recording)
        interrupted = False
        try:
            reason = simulation.run()
        except KeyboardInterrupt:
            reason, interrupted = "interrupted", True
        finally:
            if recording:
                recording.close()
        outcome = simulation.evaluate(reason).in_folder(folder)
    result = write_files(outcome, events.failure)
    if interrupted:
        raise KeyboardInterrupt
    return result


def _begin_recording(scenario: Scenario, folder: Path) -> SimulatedRecording | None:
    """A recording in ``folder`` if the scenario asks for one, else None."""
    return SimulatedRecording(folder, STARTED_AT, scenario.record.limit_gb) if scenario.record else None


class Simulation:
    """One run of a prepared ``scenario`` on the simulator; ``id``: its name on the bus.

    Args:
        events: log of the events of the run, if one is written.
        on_update: called about every ``UPDATE_S`` with the progress of the areas.
        subscriber: receives every event, in order.
    """

    def __init__(
        self,
        scenario: Scenario,
        events: EventLog | None = None,
        on_update: Callable[[Progress], None] | None = None,
        subscriber: Subscriber | None = None,
    ) -> None:
        self._started = time.monotonic()
        self._next_update = self._started
        self._scenario = scenario
        self._closed: Mapping[str, bool] = {}  # switch that events have operated -> its true status
        self._events = events
        self._states = StateLog(events)
        self._schedule = FaultSchedule.of(scenario.faults.events)
        self._on_update = on_update
        self._subscriber = subscriber or Subscriber()
        self.id = f"{default_run_id(scenario.name)}-{scenario.seed % 2**32:08x}"  # as long as that of processes
        self._observer = make_observer(scenario, self.id)
        self._telemetry = self._first_telemetry = make_telemetry(scenario)
        self._centralised = estimate_centralised(scenario, self._telemetry)
        self._write(0.0, "run started", run=self.id, scenario=scenario.name, seed=scenario.seed)
        files = area_files(scenario, self.id, NO_BUS, time=STARTED_AT)
        self._subscriber.begin(self.id, files)
        late_s = find_lateness(scenario, FIRST_SCAN)
        self._used = UsedReadings(scenario)
        self._bus = SimulatedBus(
            files,
            self._telemetry.by_area,
            self._take_state,
            self._take_presence,
            late_s=late_s,
            on_message=self._subscriber.take_message,
            on_readings=self._take_readings,
            statuses=self._find_operated(0.0).read,
        )
        self._held = HeldReadings(scenario.common_rules.kinds)
        self._held.take(self._telemetry.by_area, STARTED_AT)
        self._renew_later()
        self._faults = SimulatorFaults(self._bus, scenario.transport.routers)

    def run(self) -> str | None:
        """Goes on until consensus, and returns None. Returns the reason if the time limit passes, or if no step is left
        and the areas cannot reach consensus any more.
        """
        settings = self._scenario.run
        check_s = settings.beat_s / CHECKS_PER_HEARTBEAT_S
        while True:
            until = min(settings.timeout_s, self._schedule.next_at)
            self._bus.run(min(check_s, until - self._bus.now))
            now = self._bus.now
            for step in self._schedule.carry_out(now, self._carry_out):
                self._write(now, "fault", kind=step.kind, names=step.names)
                self._observer.take_fault(now)
            standing = self._observer.standing(now)
            obstacles = (*self._schedule.describe_obstacles(), *standing.obstacles)
            obstacles = obstacles or tuple(self._used.find_missing(self._observer.states))
            if now - self._observer.changed_at >= check_s and not obstacles:
                return None
            if not self._schedule.steps and standing.dead_end:
                return standing.dead_end
            if now >= settings.timeout_s:
                return no_consensus_within(self._scenario, obstacles)

    def _carry_out(self, step: Step) -> None:
        """Carries out a step of the scenario. After a switch or its status has changed, the plant reads all meters."""
        if step.kind not in SWITCHING:
            self._faults.do(step)
            return
        operated = self._find_operated(self._bus.now)
        self._closed, self._bus.statuses = operated.closed, operated.read
        self._telemetry = make_telemetry(self._scenario, DRAW, self._closed)
        if self._scenario.renew_s is None:
            self._bus.next_scan(self._telemetry.by_area, find_lateness(self._scenario, self._bus.scan + 1))
        else:
            self._used.operated_at = STARTED_AT + self._bus.now
            self._renew()

    def _find_operated(self, elapsed_s: float) -> Operated:
        return find_operated(self._scenario.faults.events, self._scenario.network.switches, elapsed_s)

    def _renew_later(self) -> None:
        """Schedules the next scan of the plant, if the scenario has an interval of scans."""
        if self._scenario.renew_s is not None:
            self._bus.at(self._bus.now + self._scenario.renew_s, self._renew_in_turn)

    def _renew_in_turn(self) -> None:
        self._renew()
        self._renew_later()

    def _renew(self) -> None:
        scan = self._bus.scan + 1
        fresh = make_telemetry(self._scenario, scan, self._closed).by_area
        readings, read_at = self._held.take(fresh, STARTED_AT + self._bus.now)
        times = {meter_id: at - STARTED_AT for meter_id, at in read_at.items()}
        self._bus.next_scan(readings, find_lateness(self._scenario, scan), times)

    def evaluate(self, reason: str | None) -> RunOutcome:
        """The outcome up to now. ``reason``: for which there is no consensus; None after consensus."""
        now = self._bus.now
        self._write(now, "consensus" if reason is None else "no consensus", reason=reason)
        self._write(now, "run ended")
        telemetry, centralised = self._used.put_into(self._telemetry, self._observer.states), self._centralised
        scenario = self._scenario.operated(find_statuses(self._scenario.partition, self._observer.states))
        if telemetry is not self._first_telemetry or scenario is not self._scenario:
            centralised = estimate_centralised(scenario, telemetry)
        return evaluate(
            self._scenario,
            self.id,
            self._observer,
            telemetry,
            centralised,
            reason,
            started=0.0,
            wall_s=time.monotonic() - self._started,
            virtual_s=now,
            timing_s={"last_change": max(0.0, self._observer.changed_at), "verdict": now},
            faults=self._states.faults + self._schedule.counts,
        )

    def _take_state(self, at: float, state: StateMessage) -> None:
        self._subscriber.take_state(at, state)
        is_new = self._observer.take_state(state, at)
        if self._observer.watcher.state_of(state.header.sender) is state:
            self._states.take(state, at, is_new)
        if self._on_update and time.monotonic() >= self._next_update:
            self._on_update(describe_progress(self._observer, at, self._observer.standing(at).obstacles))
            self._next_update = time.monotonic() + UPDATE_S

    def _take_readings(self, at: float, readings: ReadingsMessage) -> None:
        self._subscriber.take_readings(at, readings)
        self._used.take(readings)

    def _take_presence(self, at: float, area: str, alive: bool) -> None:
        self._subscriber.take_presence(at, area, alive)
        self._observer.take_presence(area, alive, at)
        self._write(at, "appeared" if alive else "vanished", role="area", name=area)

    def _write(self, at: float, event: str, **details: Any) -> None:
        if self._events:
            self._events.write(event, at, **details)


class SimulatorFaults:
    """Carries out the steps of a scenario on ``bus``. ``routers``: number of linked routers that carry its messages.

    A plant that is dead or frozen publishes nothing, and has the same readings afterwards. A frozen router passes no
    message, and presence tokens stay. When the last router dies, every area sees the tokens of its neighbours vanish.
    All processes are linked to the first of two routers, and move to the other one at once when it dies.
    """

    def __init__(self, bus: SimulatedBus, routers: int) -> None:
        self._bus = bus
        self._alive = list(ROUTERS[:routers])  # the first one carries all messages
        self._frozen: dict[str, float] = {}  # router -> virtual time at which it was frozen

    def do(self, step: Step) -> None:
        """Carries out one step. Cuts of links do nothing here, because the links follow the times of their files."""
        name = step.names[0]
        match step.kind, name:
            case "kill" | "pause" | "silent", "plant":
                self._bus.plant_publishes = False
            case "restart" | "resume" | "speak", "plant":
                self._bus.plant_publishes = True
            case _ if name in ROUTERS:
                self._do_to_router(step.kind, name)
            case "kill", _:
                self._bus.kill(name)
            case "restart", _:
                self._bus.kill(name)
                self._bus.start(name)
            case "pause", _:
                self._bus.pause(name)
            case "resume", _:
                self._bus.resume(name)

    def _do_to_router(self, kind: str, name: str) -> None:
        if kind in ("kill", "restart"):
            self._frozen.pop(name, None)
            if self._alive == [name]:
                self._bus.stop_router()
            self._alive = [other for other in self._alive if other != name]
        if kind == "restart":
            self._alive.append(name)
            if self._alive == [name]:
                self._bus.start_router()
        elif kind == "pause":
            self._frozen[name] = since = self._bus.now
            self._bus.at(since + LEASE_S, lambda: self._give_up(name, since))
        elif kind == "resume":
            self._frozen.pop(name, None)
        self._bus.router_runs = bool(self._alive) and self._alive[0] not in self._frozen

    def _give_up(self, name: str, since: float) -> None:
        """Moves all processes from router ``name`` to the other one, if it is still frozen since ``since``."""
        if self._frozen.get(name) == since:
            self._alive.sort(key=lambda other: other in self._frozen)
            self._bus.router_runs = self._alive[0] not in self._frozen
