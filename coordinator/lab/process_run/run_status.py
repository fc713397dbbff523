"""Status of a run under way: updates from its processes and areas, the record made of them, and its clock."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from agents.messages.checks import MessageError, should_log
from agents.messages.keys import clock_key, live_key, name_of_live, sender_of
from agents.messages.packing import ClockMessage, Header, Incarnation, ReadingsMessage, StateMessage, decode, encode
from agents.runtime.presence import Presence, begin_incarnation, read_leave
from agents.security.access import COORDINATOR, ROUTERS
from agents.transport.zenoh_bus import Session
from coordinator.lab.evaluation.used_readings import UsedReadings
from coordinator.lab.process_run.fork_server import Ended, Started
from coordinator.lab.process_run.processes import describe_end, read_end
from coordinator.lab.process_run.system import System
from coordinator.watch.observe.duplicates import Duplicate, Duplicates
from coordinator.watch.observe.event_log import EventLog
from coordinator.watch.observe.observer import Observer
from coordinator.watch.observe.state_log import StateLog
from coordinator.watch.observe.updates import Updates
from coordinator.watch.observe.watched_keys import PresenceByName, processes_of, readings_keys, state_keys
from dsse_core.estimation.plan import EstimationPlan
from scenarios.faults.schedule import FaultSchedule
from scenarios.faults.switching import find_next
from scenarios.scenario import Scenario


@dataclass
class RunClock:
    """Publishes at every heartbeat through ``publish``; silent where it is None. ``incarnation``: the coordinator's."""

    run: str
    heartbeat_s: float
    incarnation: Incarnation
    publish: Callable[[bytes], None] | None = None
    _sent: int = 0
    _next: float = field(default=0.0)

    def tick(self, elapsed_s: float) -> None:
        """Publishes ``elapsed_s``, the duration of the run in seconds, if a heartbeat is due."""
        if self.publish is None or elapsed_s < self._next:
            return
        self._next = elapsed_s + self.heartbeat_s
        self._sent += 1
        header = Header(self.run, COORDINATOR, self.incarnation, 0, self._sent, time.time())
        self.publish(encode(ClockMessage(header, elapsed_s)))


@dataclass(frozen=True, slots=True)
class _StateReceived:
    at: float
    state: StateMessage


@dataclass(frozen=True, slots=True)
class _PresenceSeen:
    at: float
    key: str
    alive: bool
    leave_reason: str = ""


@dataclass(frozen=True, slots=True)
class ProcessUpdate:
    """The start or end of a process, received at monotonic time ``at``, s."""

    at: float
    update: Started | Ended


@dataclass
class RunUnderWay:
    """A run under way: its processes, the updates that wait, and the record of those taken in."""

    scenario: Scenario
    id: str
    folder: Path
    system: System
    events: EventLog
    started: float
    plan: EstimationPlan | None = None  # of the whole grid, where the check has made it
    updates: Updates = field(default_factory=Updates)
    presence: Presence = field(default_factory=Presence)
    rejected: Counter[str] = field(default_factory=Counter)  # by reason
    joined: float | None = None  # monotonic time at which all areas were on the bus for the first time
    timing_s: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.schedule = FaultSchedule.of(self.scenario.faults.events)
        self.states = StateLog(self.events)
        self.used = UsedReadings(self.scenario)
        self.duplicates = Duplicates(self.scenario.run.beat_s)
        self.clock = RunClock(self.id, self.scenario.run.beat_s, begin_incarnation())

    def note_time(self, moment: str) -> None:
        self.timing_s[moment] = time.monotonic() - self.started


def listen_to_processes(run: RunUnderWay) -> None:
    """Puts starts and ends of processes into the run's updates, each with the time of its arrival."""
    run.system.launcher.on_update = lambda update: run.updates.put(ProcessUpdate(time.monotonic(), update))


def listen(run: RunUnderWay, session: Session) -> None:
    """Puts states, readings and presence into the run's updates, states and presence with the time of their arrival.

    Announces the coordinator on the bus, and lets the run's clock publish if faults of links have windows, or events
    operate switches.
    """

    areas = {area.name for area in run.scenario.partition.areas}

    def on_shown(key: str, payload: bytes) -> None:
        try:
            message = decode(payload)
        except MessageError as error:
            run.updates.offer(error)
            return
        if isinstance(message, StateMessage) and message.header.sender == sender_of(key):
            run.updates.offer(_StateReceived(time.monotonic(), message), size=len(payload))
        elif isinstance(message, ReadingsMessage) and message.header.sender == sender_of(key):
            run.updates.offer(message, size=len(payload))

    readings = () if run.scenario.renew_s is None else readings_keys(run.id, areas)
    for key in (*state_keys(run.id, areas), *readings):
        session.subscribe(key, on_shown)

    def on_presence(key: str, alive: bool, leave_reason: str = "") -> None:
        run.updates.offer(_PresenceSeen(time.monotonic(), key, alive, leave_reason), sent_once=True)

    def on_leave(key: str, payload: bytes) -> None:
        if leave_reason := read_leave(payload):
            on_presence(key, False, leave_reason)

    PresenceByName(session, run.id, on_presence, on_leave).ask(processes_of(areas))
    faults = run.scenario.faults
    if any(link.has_windows for link in faults.links.values()) or find_next(faults.events, -1.0) is not None:
        run.clock.publish = session.publisher(clock_key(run.id))
    session.declare_presence(live_key(run.id, "coordinator", COORDINATOR, run.clock.incarnation))


def take_update(run: RunUnderWay, observer: Observer, item: object) -> str | None:
    """Takes in one update. Returns the reason to end the run if the update is one, else None."""
    match item:
        case _StateReceived(at, state):
            is_new = observer.take_state(state, at)
            if observer.watcher.state_of(state.header.sender) is state:  # not from an unknown sender, and not outdated
                run.states.take(state, at, is_new)
        case ReadingsMessage():
            run.used.take(item)
        case _PresenceSeen(at, key, alive, leave_reason):
            if duplicate := run.duplicates.take(key, alive, at, leave_reason):
                note_duplicates(run, [duplicate], at)
            if not (run.presence.take_leave(key) if leave_reason else run.presence.take(key, alive)):
                return None
            role, name = name_of_live(key)
            what, why = (
                ("left", {"leave_reason": leave_reason}) if leave_reason else ("appeared" if alive else "vanished", {})
            )
            run.events.write(what, at, role=role, name=name, **why)
            if role in ("plant", "gateway"):
                observer.watcher.take_presence(key, alive, at)
            if role == "area":
                observer.take_presence(name, alive, at)
                if run.joined is None and not observer.find_absent():
                    run.joined = at
                    run.timing_s["areas_joined"] = at - run.started
        case MessageError():
            run.rejected[item.reason] += 1
            if should_log(run.rejected[item.reason]):
                run.events.write("rejected", reason=str(item), count=run.rejected[item.reason])
        case ProcessUpdate(at, update):
            reason = take_process_update(run, item)
            if reason:  # the bus may not have reported its death yet
                _note_death(run, observer, update.name, at)
            return reason
    return None


def _note_death(run: RunUnderWay, observer: Observer, name: str, at: float) -> None:
    observer.take_presence(name, False, at)
    for incarnation in run.presence.incarnations_of("plant", name):
        observer.watcher.take_presence(live_key(run.id, "plant", name, incarnation), False, at)
    if name in ROUTERS:
        observer.watcher.is_linked = False


def note_duplicates(run: RunUnderWay, duplicates: Sequence[Duplicate], at: float) -> None:
    """Writes an event for each process that was found running twice."""
    for duplicate in duplicates:
        run.events.write("two at once", at, **asdict(duplicate))


def take_process_update(run: RunUnderWay, item: ProcessUpdate) -> str | None:
    """Writes the event of a start or an end. Returns the reason to end the run after an end that was not ordered."""
    expected = run.system.note(item.update)
    match item.update:
        case Started(name, pid):
            run.events.write("process started", item.at, name=name, pid=pid)
        case Ended(name, pid, code):
            run.events.write("process ended", item.at, name=name, pid=pid, code=code)
            if expected:
                return None
            kind = f"area {name}" if name in run.scenario.partition.owner_of_bus.values() else name
            return f"{kind} died with {describe_end(code)}{_describe_log(run.system.log_of(name))}"
    return None


def _describe_log(log: Path) -> str:
    """Text with the last lines of the log of a process that has died; empty without a log, as for the parent of all."""
    if end := read_end(log):
        return f"; the end of its log {log}:\n{end}"
    return f"; its log {log} is empty" if log.exists() else ""


def note_ends(run: RunUnderWay) -> None:
    """Writes the events of the starts and ends of processes that arrived during the stop."""
    for item in run.updates.take(0.0):
        if isinstance(item, ProcessUpdate):
            take_process_update(run, item)
