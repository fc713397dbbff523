"""The operator of a running system: repeats a command until all areas and plants concerned show its effect."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from agents.messages.keys import command_key
from agents.messages.packing import CommandMessage, Header, Incarnation, StateMessage, encode
from agents.orders.order_book import REPLAYED, TOO_EARLY, TOO_OLD, UNRECORDED
from agents.runtime.presence import begin_incarnation
from agents.security.access import OPERATOR, PLANT
from agents.transport.zenoh_bus import Session
from coordinator.watch.observe.attachment import STEP_S, Attachment, attach, wait_until_whole
from coordinator.watch.observe.run_address import RunAddress
from coordinator.watch.observe.watcher import Watcher
from dsse_core.errors import DsseError, InvalidInputError
from dsse_core.files.wording import suggest
from dsse_core.grid.measurement import read_meter_id
from dsse_core.printable import listed
from scenarios.files.readings.rows import parse_meter

REPEAT_S = 0.2
LINK_S = 3.0  # wait for areas that other areas send to and a router does not show; a direct link may take longer
MOST_NAMED = 12
CURES = {
    TOO_OLD: "the clocks of its host and of this one differ; set them",
    TOO_EARLY: "the clocks of its host and of this one differ; set them",
    REPLAYED: "another operator was faster; look with `dsse watch`, and give the command again",
    UNRECORDED: "its log names the file; it must be able to write in the folder of its area file, or STATE_DIRECTORY",
}


class NotFollowedError(DsseError):
    """A command shows no effect. Names the areas or plants that have not followed it, and their reasons where known."""


@dataclass(frozen=True, slots=True)
class _Order:
    """The content of a command: meters to leave out or to use again, a new scan, the end of the process, switches."""

    meters_off: Collection[str] = ()
    meters_on: Collection[str] = ()
    scan: bool = False
    stop: bool = False
    opened: Collection[str] = ()
    closed: Collection[str] = ()


@contextmanager
def operate(address: RunAddress) -> Iterator[Operator]:
    """Joins the bus as the operator of a run, and waits until all areas on the bus have shown their states.

    Raises:
        InvalidInputError: the operator's keys cannot be used, or ``address.run`` is no name of a run.
        TransportError: no endpoint answers in time, or the bus has no run or several.
        NotFollowedError: the bus has no area of the run, or an area shows no state in time.
    """
    timeout_s = address.timeout_s
    with attach(address, OPERATOR) as look:
        watcher = wait_until_whole(look, timeout_s)
        if watcher.names_of("area"):
            _wait_for_neighbours(look, timeout_s if address.direct else min(timeout_s, LINK_S))
        areas = sorted(watcher.names_of("area"))
        if not areas:
            raise NotFollowedError(f"no area of run {look.run} is on this bus within {timeout_s:g} s")
        if silent := [area for area in areas if watcher.state_of(area) is None]:
            raise NotFollowedError(f"{listed(silent, MOST_NAMED)} show no state within {timeout_s:g} s")
        yield Operator(look.session, look.run, look, timeout_s, watcher, tuple(areas), watcher.find_absent())


def _wait_for_neighbours(look: Attachment, timeout_s: float) -> None:
    """Waits up to ``timeout_s`` until all areas that others send to are on the bus, and all areas have shown states.

    Without a router, links open one after another.
    """
    deadline = time.monotonic() + timeout_s
    while ((watcher := look(STEP_S)).find_absent() or not watcher.is_whole()) and time.monotonic() < deadline:
        pass


@dataclass
class Operator:
    """An operator on the bus.

    ``areas``: the areas on the bus at the start. ``absent``: the areas that they send to and that were not on the bus.
    """

    session: Session
    run: str
    look: Attachment
    timeout_s: float
    watcher: Watcher
    areas: tuple[str, ...]
    absent: tuple[str, ...]
    _incarnation: Incarnation = field(default_factory=begin_incarnation)
    _sequence: int = 0
    _publishers: dict[str, Callable[[bytes], None]] = field(default_factory=dict)

    def switch_off(self, meters: Collection[str]) -> dict[str, str]:
        """Switches ``meters`` off in the areas that own them, and returns the owners: meter -> area.

        Raises:
            InvalidInputError: a text is no id of a meter, and no order was given; or an id belongs to no area, and the
                meters that this call switched off are on again.
            NotFollowedError: an area does not follow in time.
        """
        if problems := [problem for meter in meters if isinstance(problem := parse_meter(meter), str)]:
            raise InvalidInputError(f"run {self.run}", problems)
        before = {area: self._off_in(area) for area in self.areas}
        self._give(
            {area: _Order(meters_off=meters) for area in self.areas}, until=lambda: set(meters) <= self._owners().keys()
        )
        owners = self._owners()
        if unknown := [meter for meter in meters if meter not in owners]:
            # Only the areas know their meters, so the mistake shows after the other meters have been switched off.
            new = {area: self._off_in(area).intersection(meters) - before[area] for area in self.areas}
            self._give({area: _Order(meters_on=of_area) for area, of_area in new.items() if of_area})
            where = f"ids are in the area files of areas {listed(self.areas, MOST_NAMED)}"
            where += f"; not on the bus: {listed(self.absent, MOST_NAMED)}" if self.absent else ""
            problems = [f"no area has a meter {meter!r}{self._find_place(meter)}; {where}" for meter in unknown]
            raise InvalidInputError(f"run {self.run}", problems)
        return {meter: owners[meter] for meter in meters}

    def switch_on(self, meters: Collection[str]) -> dict[str, str]:
        """Switches ``meters``, which are off, on again, and returns their areas: meter -> area.

        Raises:
            InvalidInputError: a meter is not off.
            NotFollowedError: an area does not follow in time.
        """
        owners = self._owners()
        if not_off := [meter for meter in meters if meter not in owners]:
            there = f"off are {listed(sorted(owners), MOST_NAMED)}" if owners else "none is"
            raise InvalidInputError(f"run {self.run}", [f"meter {meter!r} is not off; {there}" for meter in not_off])
        concerned = {owners[meter] for meter in meters}
        self._give({area: _Order(meters_on=meters) for area in concerned})
        return {meter: owners[meter] for meter in meters}

    def set_switches(self, switches: Collection[str], *, closed: bool) -> dict[str, str]:
        """States that ``switches`` are ``closed``, or open, to the areas that hold them: switch -> area.

        Raises:
            InvalidInputError: an id is that of no switch; then no order is given.
            NotFollowedError: an area does not follow in time.
        """
        holders = {switch: area for area in self.areas for switch in self._state_of(area).switches}
        if unknown := [switch for switch in switches if switch not in holders]:
            known = f"switches are {listed(sorted(holders), MOST_NAMED)}" if holders else "there is no switch"
            known += f"; not on the bus: {listed(self.absent, MOST_NAMED)}" if self.absent else ""
            known += "; give ids; a branch becomes a switch by `switch = true` in the network file and a new split"
            problems = [f"no area holds a switch {s!r}{suggest(s, holders)}; {known}" for s in unknown]
            raise InvalidInputError(f"run {self.run}", problems)
        by_area: dict[str, list[str]] = {}
        for switch in switches:
            by_area.setdefault(holders[switch], []).append(switch)
        self._give({a: _Order(closed=own) if closed else _Order(opened=own) for a, own in by_area.items()})
        return {switch: holders[switch] for switch in switches}

    def scan(self) -> str:
        """Has the plant make a new scan. Without a plant, all areas take the newest readings. Returns a line that says
        which of the two was done, and in which areas.

        Raises:
            NotFollowedError: an area does not show the new scan in time, or does not follow.
        """
        if PLANT not in self.watcher.names_of("plant"):
            self._give({area: _Order(scan=True) for area in self.areas})
            return f"{', '.join(self.areas)}: the newest readings are taken"
        before = {area: self._state_of(area).header.scan for area in self.areas}

        def find_left() -> list[str]:
            return [area for area in self.areas if self._state_of(area).header.scan <= before[area]]

        self._give({PLANT: _Order(scan=True)}, find_left)
        return f"{', '.join(self.areas)}: scan {max(self._state_of(area).header.scan for area in self.areas)}"

    def stop(self) -> list[str]:
        """Ends the processes of all areas and of the plant, and returns their names.

        Raises:
            NotFollowedError: an area or the plant is still on the bus at the end of the time limit.
        """
        plants = sorted(self.watcher.names_of("plant") & {PLANT})
        orders = {area: _Order(stop=True) for area in self.areas}
        orders |= {plant: _Order(stop=True) for plant in plants}

        def find_left() -> list[str]:
            there = self.watcher.names_of("area") | self.watcher.names_of("plant")
            return [name for name in orders if name in there]

        self._give(orders, find_left)
        return [*self.areas, *plants]

    def _give(
        self,
        orders: Mapping[str, _Order],
        find_left: Callable[[], Sequence[str]] | None = None,
        until: Callable[[], bool] = lambda: False,
    ) -> None:
        """Repeats ``orders`` (name of an area or plant -> its order) until all have followed, or ``until`` holds.

        An area follows only an order with a number above that of the last one it has followed. Where another operator
        was faster, the order is sent again with a number above the other's, so that no order is lost when two
        operators act at once. ``find_left``: names that have not followed yet.

        Raises:
            NotFollowedError: names are left at the end of the time limit.
        """
        before = {area: dict(self._state_of(area).rejected) for area in self.areas}
        numbers = {name: self._next_order(name) for name in orders}
        find_left = find_left or (lambda: [n for n, number in numbers.items() if self._followed_by(n) != number])
        deadline, next_time = time.monotonic() + self.timeout_s, 0.0
        while (left := find_left()) and not until():
            now = time.monotonic()
            if now > deadline:
                raise NotFollowedError("; ".join(self._explain(name, before.get(name, {})) for name in left))
            if now >= next_time:
                next_time = now + REPEAT_S
                for name in orders:
                    if self._followed_by(name) > numbers[name]:
                        numbers[name] = self._next_order(name)
                    self._publish(name, orders[name], numbers[name])
            self.look(STEP_S)

    def _publish(self, name: str, order: _Order, number: tuple[Incarnation, int]) -> None:
        incarnation, sequence = number
        header = Header(self.run, OPERATOR, incarnation, 0, sequence, time.time())
        off, on = tuple(sorted(order.meters_off)), tuple(sorted(order.meters_on))
        opened, closed = tuple(sorted(order.opened)), tuple(sorted(order.closed))
        message = CommandMessage(header, name, off, on, order.scan, order.stop, opened, closed)
        if name not in self._publishers:
            self._publishers[name] = self.session.publisher(command_key(self.run, name))
        self._publishers[name](encode(message))

    def _next_order(self, name: str) -> tuple[Incarnation, int]:
        """Returns an order number above that of the last order that ``name`` has followed, even if the clock of that
        operator ran ahead. Two operators do not give the same number: it holds the random part of this incarnation.
        """
        self._sequence += 1
        followed, own = self._followed_by(name), self._incarnation
        if (own, self._sequence) < followed:
            own = Incarnation(followed[0].start_ms + 1, own.random)
        return own, self._sequence

    def _followed_by(self, name: str) -> tuple[Incarnation, int]:
        state = self.watcher.state_of(name)
        start_ms, random, sequence = state.command if state else (0, 0, 0)
        return Incarnation(start_ms, random), sequence

    def _explain(self, name: str, before: Mapping[str, int]) -> str:
        """Sentence on why ``name`` has not followed. ``before``: its counts of rejected messages before the command."""
        state = self.watcher.state_of(name)
        more = {r for r, count in (state.rejected if state else {}).items() if count > before.get(r, 0)}
        reasons = [f"{reason} ({cure})" for reason, cure in CURES.items() if reason in more]
        why = f"it rejects: {', '.join(reasons)}" if reasons else "it says nothing about it"
        return f"{name} has not followed the command within {self.timeout_s:g} s: {why}"

    def _state_of(self, area: str) -> StateMessage:
        state = self.watcher.state_of(area)
        assert state is not None  # it has been waited for
        return state

    def _off_in(self, area: str) -> set[str]:
        return set(self._state_of(area).meters_off)

    def _find_place(self, meter: str) -> str:
        """Text on the bus of an unknown ``meter``: the areas that have it, and its phases; or the buses next to it."""
        found = read_meter_id(meter)
        assert found is not None  # it has been parsed
        bus = found.bus
        states = {area: self._state_of(area) for area in self.areas}
        if here := [area for area, state in states.items() if bus in state.buses]:
            phases = states[here[0]].phases_at(bus)
            which = f", with phases {', '.join(phases)}" if "".join(phases) else ""
            return f" (bus {bus} is in {listed(here, MOST_NAMED)}{which})"
        near = sorted({b for state in states.values() for b in state.buses}, key=lambda b: (abs(b - bus), b))[:3]
        return f" (no area shows bus {bus}; near are {', '.join(map(str, sorted(near)))})"

    def _owners(self) -> dict[str, str]:
        """Meters that are off: id -> area."""
        return {meter: area for area in self.areas for meter in self._state_of(area).meters_off}
