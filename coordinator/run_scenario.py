"""One run from the scenario to its verdict: start the processes, watch them, compare, write the files."""

from __future__ import annotations

import secrets
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from agents.access import COORDINATOR, PLANT
from agents.credentials import AUTHORITY, credentials_in
from agents.keys import all_live, all_states, clock_key, live_key, name_of_live, sender_of
from agents.messages import StateMessage, decode
from agents.presence import Presence, begin_life, read_farewell
from agents.transport import Session
from agents.wire_checks import MessageError, is_worth_writing
from coordinator.doubles import Double, Doubles
from coordinator.events import EventLog
from coordinator.fault_schedule import FaultSchedule
from coordinator.judging import choose_scenario, judge, make_observer, no_consensus_within
from coordinator.observer import Observer
from coordinator.process_faults import do_to_processes
from coordinator.processes import Launcher, News, describe_end, read_end
from coordinator.progress import Progress, describe_progress
from coordinator.result import RunResult, write_files
from coordinator.run_clock import RunClock
from coordinator.run_folder import make_run_folder
from coordinator.split import default_run_id
from coordinator.state_log import StateLog
from coordinator.system import System
from coordinator.yardstick import start_yardstick
from coordinator.zygote import Ended, Started
from dsse_core.area_model import uses_tree
from scenarios.check import check_scenario
from scenarios.scenario import Scenario

UPDATE_S = 0.1
DAYS_OF_A_RUN = 1.0  # that the keys of one secured run are valid


@dataclass(frozen=True, slots=True)
class _StateHeard:
    at: float
    state: StateMessage


@dataclass(frozen=True, slots=True)
class _PresenceSeen:
    at: float
    key: str
    alive: bool
    farewell: str = ""


@dataclass(frozen=True, slots=True)
class _ProcessNews:
    at: float
    news: Started | Ended


@dataclass
class _Run:
    """One run under way: its processes, what arrives from them, and what is known so far."""

    scenario: Scenario
    id: str
    folder: Path
    system: System
    events: EventLog
    started: float
    news: News = field(default_factory=News)
    presence: Presence = field(default_factory=Presence)
    refused: Counter[str] = field(default_factory=Counter)  # by reason
    joined: float | None = None  # when all areas were on the bus for the first time
    timing_s: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.schedule = FaultSchedule.of(self.scenario.faults.events)
        self.states = StateLog(self.events)
        self.doubles = Doubles(self.scenario.run.beat_s)
        self.clock = RunClock(self.id, self.scenario.run.beat_s, begin_life())

    def note_time(self, moment: str) -> None:
        self.timing_s[moment] = round(time.monotonic() - self.started, 4)


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
    """Run ``scenario`` with the processes of ``launcher``; see ``coordinator.run``. ``started``: monotonic time."""
    scenario = choose_scenario(scenario, seed, strategy, timeout_s)
    if any(map(uses_tree, scenario.partition.areas)):
        launcher.preload("agents.warm_up:warm_up")  # beside the check, which in a large grid takes as long
    check_scenario(scenario)
    folder = make_run_folder(out, default_run_id(scenario), ("areas", "logs"))
    with EventLog(folder / "events.jsonl", started) as events:
        run_id = f"{default_run_id(scenario)}-{secrets.token_hex(4)}"
        system = System(launcher, scenario, run_id, folder, keys=_find_keys(scenario, run_id, folder, secure, keys))
        run = _Run(scenario, run_id, folder, system, events, started)
        events.write("run started", run=run_id, scenario=scenario.name, seed=scenario.seed, parent_pid=launcher.pid)
        launcher.on_news = lambda news: run.news.put(_ProcessNews(time.monotonic(), news))
        run.note_time("scenario_loaded")
        try:
            run.system.start_bus(lambda: _wait_for_router(run))
            run.note_time("router_listens")
            return _run_with_router(run, on_update)
        finally:
            launcher.close()
            _note_ends(run)
            events.write("run ended")


def _find_keys(scenario: Scenario, run_id: str, folder: Path, secure: bool, keys: str | Path | None) -> Path | None:
    """The folder of credentials of a secured run, made for this run if none is given; None if it is not secured."""
    if keys is None and not secure:
        return None
    from coordinator.certificates import access_of, check_keys, create_keys  # not needed by most runs

    access = access_of(scenario.partition, run_id)
    if keys is not None:
        check_keys(Path(keys), access)
        return Path(keys).absolute()
    host = scenario.transport.listen.partition("/")[2].rpartition(":")[0]
    create_keys(folder / "keys", access, DAYS_OF_A_RUN, [host.strip("[]")])
    credentials_in(folder / "keys", AUTHORITY).key.unlink()  # nobody is to get a certificate later
    return (folder / "keys").absolute()


def _wait_for_router(run: _Run) -> str | None:
    """Let a moment pass; the reason to give up, if a process has ended."""
    for item in run.news.take(0.002):
        reason = _take_process_news(run, item)
        if reason:
            return reason
    return None


def _run_with_router(run: _Run, on_update: Callable[[Progress], None] | None) -> RunResult:
    scenario = run.scenario
    run.system.start_others()
    run.note_time("agents_started")
    observer = make_observer(scenario)
    with run.system.join(COORDINATOR) as session:
        _listen(run, session)
        yardstick = start_yardstick(scenario, lambda: run.note_time("centralised_estimated"))
        interrupted = False
        try:
            reason = _watch(run, observer, on_update)
        except KeyboardInterrupt:
            reason, interrupted = "interrupted", True
        wall_s = time.monotonic() - run.started
    run.timing_s["last_change"] = round(max(0.0, observer.changed_at - run.started), 4)
    run.note_time("verdict")
    run.events.write("consensus" if reason is None else "no consensus", reason=reason)
    run.system.launcher.stop()  # the processes end while the files are written
    telemetry, centralised = yardstick.result()
    outcome = judge(
        scenario,
        run.id,
        observer,
        telemetry,
        centralised,
        reason,
        started=run.started,
        wall_s=wall_s,
        virtual_s=None,
        timing_s=run.timing_s,
        faults=run.states.faults + run.schedule.counts,
        doubles=run.doubles.found,
    )
    result = write_files(outcome.in_folder(run.folder), run.events.failure)
    if interrupted:
        raise KeyboardInterrupt
    return result


def _listen(run: _Run, session: Session) -> None:
    """Have states and presence put into the run's news, each with the time of its arrival."""

    def on_state(key: str, payload: bytes) -> None:
        try:
            message = decode(payload)
        except MessageError as error:
            run.news.offer(error)
        else:
            if isinstance(message, StateMessage) and message.header.sender == sender_of(key):
                run.news.offer(_StateHeard(time.monotonic(), message))

    session.subscribe(all_states(run.id), on_state)
    known = {("plant", PLANT), ("coordinator", COORDINATOR)}
    known |= {("area", area.name) for area in run.scenario.partition.areas}

    def on_presence(key: str, alive: bool, farewell: str = "") -> None:
        if name_of_live(key) in known:
            run.news.put(_PresenceSeen(time.monotonic(), key, alive, farewell))

    def on_farewell(key: str, payload: bytes) -> None:
        if farewell := read_farewell(payload):
            on_presence(key, False, farewell)

    session.subscribe(all_live(run.id), on_farewell)
    session.watch_presence(all_live(run.id), on_presence)
    if any(faults.has_windows for faults in run.scenario.faults.links.values()):
        run.clock.publish = session.publisher(clock_key(run.id))
    session.declare_presence(live_key(run.id, "coordinator", COORDINATOR, run.clock.life))


def _watch(run: _Run, observer: Observer, on_update: Callable[[Progress], None] | None) -> str | None:
    """Take in news until consensus (None), the end of a process or the time limit (the reason)."""
    deadline = run.started + run.scenario.run.timeout_s
    check_s = min(run.scenario.run.beat_s / 10, UPDATE_S)
    next_check = next_update = 0.0
    while True:
        for item in run.news.take(check_s):
            reason = _take(run, observer, item)
            if reason:
                return reason
        now = time.monotonic()
        _note_doubles(run, run.doubles.find_lasting(now), now)
        _carry_out_faults(run, observer, now)
        if now < next_check:
            continue
        next_check = now + check_s
        standing = observer.standing(now)
        obstacles = (*run.schedule.describe_next(), *standing.obstacles)
        if on_update and (now >= next_update or not obstacles):
            next_update = now + UPDATE_S
            on_update(describe_progress(observer, now - run.started, standing.obstacles))
        if not obstacles:
            return None
        if not run.schedule.steps and standing.dead_end:
            return standing.dead_end
        if now >= deadline:
            return no_consensus_within(run.scenario, obstacles)


def _carry_out_faults(run: _Run, observer: Observer, now: float) -> None:
    """Do to the processes what the scenario says for this moment, and write it down; the links know by the clock."""
    if run.joined is not None:
        run.clock.tell(now - run.joined)
        for step in run.schedule.carry_out(now - run.joined, partial(do_to_processes, run.system)):
            run.events.write("fault", kind=step.kind, names=step.names)
            observer.take_fault(now)


def _take(run: _Run, observer: Observer, item: object) -> str | None:
    """Take in one piece of news; the reason to end the run, if it is one."""
    match item:
        case _StateHeard(at, state):
            is_new = state.header.run == run.id and observer.take_state(state, at)
            if observer.states.get(state.header.sender) is state:  # neither a stranger's nor one that came too late
                run.states.take(state, at, is_new)
        case _PresenceSeen(at, key, alive, farewell):
            if double := run.doubles.take(key, alive, at, farewell):
                _note_doubles(run, [double], at)
            if not (run.presence.take_farewell(key) if farewell else run.presence.take(key, alive)):
                return None
            role, name = name_of_live(key)
            what, why = ("left", {"farewell": farewell}) if farewell else ("appeared" if alive else "vanished", {})
            run.events.write(what, at, role=role, name=name, **why)
            if role == "area":
                observer.take_presence(name, alive, at)
                if run.joined is None and not observer.find_absent():
                    run.joined = at
                    run.timing_s["areas_joined"] = round(at - run.started, 4)
        case MessageError():
            run.refused[item.reason] += 1
            if is_worth_writing(run.refused[item.reason]):
                run.events.write("refused", reason=str(item), count=run.refused[item.reason])
        case _ProcessNews(at, news):
            reason = _take_process_news(run, item)
            if reason:  # the bus may not have told of its death yet
                observer.take_presence(news.name, False, at)
            return reason
    return None


def _note_doubles(run: _Run, doubles: Sequence[Double], at: float) -> None:
    for double in doubles:
        run.events.write("two at once", at, **asdict(double))


def _take_process_news(run: _Run, item: _ProcessNews) -> str | None:
    """Write it down; an end is a reason to end the run."""
    expected = run.system.note(item.news)
    match item.news:
        case Started(name, pid):
            run.events.write("process started", item.at, name=name, pid=pid)
        case Ended(name, pid, code):
            run.events.write("process ended", item.at, name=name, pid=pid, code=code)
            if expected:
                return None
            kind = f"area {name}" if name in run.scenario.partition.owner_of_bus.values() else name
            end = read_end(run.system.log_of(name))
            return f"{kind} died with {describe_end(code)}" + (
                f"; the end of its log {run.system.log_of(name)}:\n{end}"
                if end
                else f"; its log {run.system.log_of(name)} is empty"
            )
    return None


def _note_ends(run: _Run) -> None:
    """Write down the orderly ends that arrived while stopping."""
    for item in run.news.take(0.0):
        if isinstance(item, _ProcessNews):
            _take_process_news(run, item)
