"""Consensus of a run, as a function of what its watcher has received. No bus, no clock, no centralised result.

Consensus: every area is alive, has an estimate of the current scan whose angles count from the substation,
agrees with the others at every boundary bus and has received the last messages of its neighbours. Areas publish
their states at rest, and only a new message can wake them: when all messages sent have been received, no more will
follow.

Two more conditions hold after a restart, whose messages are numbered from one again, and after any other fault of
processes or links that the scenario makes. Nothing has changed for two heartbeats, in which every area has repeated its
state. Every area has received telemetry since the fault, as areas may agree on estimates after the plant is lost.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from agents.messages.keys import live_key
from agents.messages.packing import NO_INCARNATION, StateMessage
from agents.peers.orders_and_ages import PATIENCE_HEARTBEATS
from agents.protocol.quality import GOOD, NONE, STALE, UNOBSERVABLE, Assessment, assess_from_outside
from coordinator.watch.observe.mismatch import find_mismatches
from coordinator.watch.observe.watcher import Watcher, count_exchanges
from dsse_core.grid.nodes import name_node
from dsse_core.grid.partition import Partition
from dsse_core.printable import printable

QUIET_HEARTBEATS = 2
SETTLING_HEARTBEATS = 3  # after the last change; a quality not good by then stays so, unless messages are lost
MAX_NAMED = 12  # areas
LEAST_DEAD_END_S = 5.0  # of waiting for telemetry: on a busy machine the plant may be late


@dataclass(frozen=True, slots=True)
class Standing:
    """Distance of a run from consensus.

    ``obstacles``: the missing conditions of consensus, in words that name areas and buses; empty at consensus.
    ``dead_end``: the reason that consensus can no longer come by waiting; None while it can.
    """

    obstacles: tuple[str, ...]
    dead_end: str | None = None


@dataclass(frozen=True, slots=True, repr=False)
class Sample:
    """An area's published state at time ``time`` (s, the observer's clock): numbers of its nodes, p.u. and rad.

    ``referenced``: ``va`` counts from the substation.
    """

    time: float
    area: str
    buses: tuple[int, ...]
    vm: Sequence[float]
    va: Sequence[float]
    referenced: bool

    def __repr__(self) -> str:
        return f"<Sample of {self.area!r} at {self.time:.3f} s: {len(self.buses)} buses>"


@dataclass
class _Course:
    """Course of an area's states."""

    buses: tuple[int, ...] = ()  # of the last state with an estimate
    repeats: int = 0  # of the state since change number ``change``, the newest of any area when the last repeat came
    change: int = 0


@dataclass
class Observer:
    """Takes in states and presence of the areas of run ``run`` with the time of their arrival, and tests consensus.

    ``watcher`` keeps states and presence, and judges their age, for this run as for any other.

    Args:
        tolerance_va, tolerance_vm: largest mismatch of areas that agree at a boundary bus, rad and p.u.
        heartbeat_s: interval at which areas repeat their states.
        compare_magnitudes: True where the strategy reconciles voltage magnitudes.
    """

    run: str
    partition: Partition
    tolerance_va: float
    tolerance_vm: float
    heartbeat_s: float
    compare_magnitudes: bool
    history: list[Sample] = field(default_factory=list)
    changed_at: float = -math.inf

    def __post_init__(self) -> None:
        self._courses = {area.name: _Course() for area in self.partition.areas}
        self._networks = {area.name: area.network for area in self.partition.areas}
        self._boundaries_of: dict[str, list[tuple[int, tuple[str, ...]]]] = {}
        for bus, names in self.partition.boundaries.items():
            for name in names:
                self._boundaries_of.setdefault(name, []).append((bus, names))
        self.watcher = Watcher(self.run, frozenset(self._networks))
        self._changes = 0
        self._disturbed_at = -math.inf  # time of the last disturbance

    @property
    def states(self) -> Mapping[str, StateMessage]:
        """The newest state of every area that has published one."""
        return self.watcher.states

    @property
    def scan(self) -> int:
        """The current scan: the newest that any area works on; 0 before telemetry."""
        return max((state.header.scan for state in self.states.values()), default=0)

    @property
    def exchanges(self) -> int:
        """The largest number of changed messages on one directed link, load and boundary messages together."""
        return max((count_exchanges(state) for state in self.states.values()), default=0)

    def take_state(self, state: StateMessage, now: float) -> bool:
        """Keep ``state`` as the watcher does; True unless it is a repeat, or not kept."""
        course = self._courses.get(state.header.sender)
        last = self.watcher.state_of(state.header.sender)
        if course is None or not self._is_of_its_area(state) or not self.watcher.take_state(state, now):
            return False
        if last is not None and state.header.incarnation != last.header.incarnation:
            self._disturbed_at = now
        if last is not None and state.header.order == last.header.order:
            course.repeats = self._repeats(course) + 1
            course.change = self._changes
            return False
        self._note_change(now)
        if state.buses:
            vm, va = array("d", state.vm), array("d", state.va)  # a quarter of the memory of tuples; there are many
            if course.buses != state.buses:  # else the same tuple again, not one for each state
                course.buses = state.buses
            self.history.append(Sample(now, state.header.sender, course.buses, vm, va, state.referenced))
        return True

    def _is_of_its_area(self, state: StateMessage) -> bool:
        """True where the state's nodes are those of its area, or the state has no estimate."""
        own = self._networks[state.header.sender]
        if not state.buses:
            return True
        return set(state.nodes) == set(own.nodes)

    def take_presence(self, area: str, alive: bool, now: float) -> bool:
        """Note that an area's token appeared or vanished; True where this is a change."""
        if area not in self._courses or self.watcher.is_present(area) == alive:
            return False
        self.watcher.take_presence(live_key(self.run, "area", area, NO_INCARNATION), alive, now)
        if not alive:
            self._disturbed_at = now
        self._note_change(now)
        return True

    def take_fault(self, now: float) -> None:
        """Note a fault that the scenario has made: an area may be dead, although its token has not vanished yet."""
        self._disturbed_at = now
        self._note_change(now)

    def assess_area(self, area: str, now: float) -> Assessment:
        """Quality of the area's last state at time ``now``, with reasons; stale once the area is gone or silent."""
        state = self.watcher.state_of(area)
        if state is None:
            return assess_from_outside(None, "")
        silence = "" if self.watcher.is_present(area) else f"{area} is not on the bus"
        if not silence and self.watcher.is_silent(area, now):
            silence = f"{area} has sent nothing for {self.watcher.age_of(area, now):.1f} s"
        return assess_from_outside(state, silence, tuple(self._find_disputes(area)))

    def _find_disputes(self, area: str) -> Iterator[str]:
        """Sentences on boundary buses where a neighbour publishes another voltage for the same scan.

        One of the two areas has received false numbers."""
        for bus, names in self._boundaries_of.get(area, ()):
            others = names[1:] if area == names[0] else names[:1]
            for other in others:
                one, two = self.watcher.state_of(area), self.watcher.state_of(other)
                if one is None or two is None or not (one.buses and two.buses and one.referenced and two.referenced):
                    continue
                if one.header.scan == two.header.scan:
                    yield from self._find_disagreements(bus, [area, other])

    def quality_of(self, area: str, now: float) -> str:
        """Quality of the area's last state at time ``now``, without reasons."""
        return self.assess_area(area, now).quality

    def standing(self, now: float) -> Standing:
        """The missing conditions of consensus at time ``now``, and the reason if it can no longer come."""
        if disunity := self._find_disunity(now):
            return Standing(tuple(disunity), self._find_unobservable(now))
        ages = self._find_cut_off(now)
        obstacles = tuple(f"{name} has received no telemetry for {age:.1f} s" for name, age in ages.items())
        if now - self.changed_at < SETTLING_HEARTBEATS * self.heartbeat_s:  # neighbours' rest not known yet
            qualities = {name: self.quality_of(name, now) for name in self._courses}
            obstacles += tuple(f"{name} is {quality}" for name, quality in qualities.items() if quality != GOOD)
        return Standing(obstacles, self._find_dead_end(ages))

    def _find_unobservable(self, now: float) -> str | None:
        """Sentence that the readings of this scan do not determine the state; else None."""
        if any(self.quality_of(name, now) != UNOBSERVABLE for name in self._courses):
            return None
        if now - self.changed_at < self._longest_wait_s:
            return None
        first = next(iter(self.states.values()))
        return f"the readings of scan {self.scan} do not determine the state: {'; '.join(first.notes)}"

    @property
    def _longest_wait_s(self) -> float:
        """Age of telemetry, or of the last change, after which waiting helps no more, s."""
        return max(PATIENCE_HEARTBEATS * self.heartbeat_s, LEAST_DEAD_END_S)

    def _find_dead_end(self, ages: Mapping[str, float]) -> str | None:
        """Sentence that the areas agree on estimates that have been stale for long; None while waiting may help.

        ``ages``: area -> time since its last telemetry, s, of those that lack it."""
        if not ages or min(ages.values()) < self._longest_wait_s:
            return None
        named = ", ".join(list(ages)[:MAX_NAMED]) + (f" and {len(ages) - MAX_NAMED} more" * (len(ages) > MAX_NAMED))
        return (
            f"the areas agree, but on stale estimates: {named} received the last telemetry, of scan {self.scan}, "
            f"{min(ages.values()):.1f} s ago; is the plant or gateway gone?"
        )

    def _find_cut_off(self, now: float) -> dict[str, float]:
        """Area -> time since its last telemetry, s; for areas stale or without telemetry since the last disturbance."""
        found = {}
        for name in self._courses:
            state = self.watcher.state_of(name)
            if state is None or state.quality == NONE:
                continue
            telemetry_at = now - self.watcher.age_of(name, now) - state.telemetry_age
            if self.quality_of(name, now) == STALE or telemetry_at < self._disturbed_at:
                found[name] = now - telemetry_at
        return found

    def _find_disunity(self, now: float) -> list[str]:
        """The missing conditions of agreement, in words; the quality of the estimates does not count here."""
        states, scan, obstacles = self.states, self.scan, []
        for name in self._courses:
            obstacle = self._find_area_obstacle(name, scan)
            if obstacle:
                obstacles.append(obstacle)
        for bus, names in self.partition.boundaries.items():
            obstacles += self._find_disagreements(
                bus, [name for name in names if name in states and states[name].buses]
            )
        obstacles += self._find_unacknowledged()
        if not obstacles and self._disturbed_at > -math.inf and not self._is_quiet(now):
            obstacles.append(
                f"something has changed within the last {QUIET_HEARTBEATS} heartbeats, after a restart or another fault"
            )
        return obstacles

    def _is_quiet(self, now: float) -> bool:
        """True where nothing has changed for QUIET_HEARTBEATS, and every area has repeated its state as often."""
        if now - self.changed_at < QUIET_HEARTBEATS * self.heartbeat_s:
            return False
        return min(map(self._repeats, self._courses.values()), default=0) >= QUIET_HEARTBEATS

    def find_absent(self) -> tuple[str, ...]:
        """The areas that are not on the bus."""
        return tuple(name for name in self._courses if not self.watcher.is_present(name))

    def _note_change(self, now: float) -> None:
        self.changed_at = now
        self._changes += 1

    def _repeats(self, course: _Course) -> int:
        """Number of repeats of the area's state since the last change of any area."""
        return course.repeats if course.change == self._changes else 0

    def _find_area_obstacle(self, name: str, scan: int) -> str | None:
        state = self.watcher.state_of(name)
        if not self.watcher.is_present(name):
            return f"{name} is not on the bus"
        if state is None:
            return f"{name} has not shown a state"
        notes = f": {printable('; '.join(state.notes))}" if state.notes else ""
        if state.header.scan == 0:
            return f"{name} has no telemetry"
        if state.header.scan != scan:
            return f"{name} works on scan {state.header.scan}, the current one is {scan}"
        if not state.buses:
            return f"{name} has no estimate{notes}"
        if not state.referenced:
            return f"the angles of {name} do not count from the substation yet{notes}"
        if not state.checked:
            return f"{name} waits until bad data have been looked for in the whole feeder{notes}"
        return None

    def _find_disagreements(self, bus: int, names: list[str]) -> list[str]:
        found = []
        for other in names[1:]:
            for node, (vm, va) in self.find_mismatches([bus], names[0], other).items():
                place = f"at bus {name_node(*node)}"
                if va > self.tolerance_va:
                    found.append(f"{names[0]} and {other} differ by {math.degrees(va):.3g} deg {place}")
                if self.compare_magnitudes and vm > self.tolerance_vm:
                    found.append(f"{names[0]} and {other} differ by {vm:.3g} p.u. {place}")
        return found

    def find_mismatches(self, buses: Iterable[int], one: str, other: str) -> dict[tuple[int, str], tuple[float, float]]:
        """Differences of two areas at ``buses``, see ``mismatch.py``; none while one of them has no state."""
        ours, theirs = self.watcher.state_of(one), self.watcher.state_of(other)
        return {} if ours is None or theirs is None else find_mismatches(buses, ours, theirs)

    def _find_unacknowledged(self) -> list[str]:
        """Sentences on messages that are not received yet or not sent, between areas that are on the bus."""
        states = {name: state for name, state in self.states.items() if self.watcher.is_present(name)}
        found = []
        for area in self.partition.areas:
            for n in area.neighbours:
                sender, receiver = states.get(area.name), states.get(n.area)
                if sender is None or receiver is None:
                    continue
                sent, received = (
                    numbers.get(name, (0, 0))
                    for numbers, name in ((sender.sent, n.area), (receiver.received, area.name))
                )
                for kind, n_sent, n_received in zip(("load", "boundary"), sent, received, strict=True):
                    if n_sent == 0:
                        found.append(f"{area.name} has sent {n.area} no {kind} message")
                    elif n_received != n_sent:
                        found.append(f"{n.area} has not received the last {kind} message of {area.name}")
        return found
