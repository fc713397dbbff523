"""Watcher of a running system, without its scenario: present processes, and the areas' states. No bus, no clock."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import islice
from typing import Any

import numpy as np

from agents.messages.keys import name_of_live, version_of
from agents.messages.packing import WIRE_VERSION, ReadingsMessage, StateMessage, describe_other_version
from agents.peers.orders_and_ages import is_old
from agents.protocol.quality import assess_from_outside
from agents.runtime.presence import MAX_NAMES, Presence
from coordinator.watch.observe.duplicates import NOUNS, describe_duplicate
from coordinator.watch.observe.mismatch import find_mismatches
from coordinator.watch.observe.notes import Noted, read_notes
from coordinator.watch.observe.view import OVER_S, AreaView, Extreme, Meeting, View
from dsse_core.grid.nodes import name_node
from dsse_core.printable import listed

MOST_VERSIONS = 10  # other wire versions that are kept apart, and
MOST_NAMED = 12  # names of each
MOST_AREAS = 1000  # that are shown where the areas' names are not known
MOST_OTHERS, MOST_DUPLICATES = 100, 100  # that are named
MOST_BYTES = 32 * 2**20  # of the messages that are kept, where the areas' names are not known
ROLES = ("plant", "coordinator", "gateway")  # of processes other than areas, named first
VANISHING = ("area", "plant", "gateway")  # roles of processes that are missed
SILENT_PAUSES = 3  # an area without a state for so many of its longest pauses, and for OVER_S, is silent


@dataclass
class Watcher:
    """Takes in presence and states of run ``run`` with the time of their arrival, s on any monotonic clock.

    ``areas``: names of the areas, if known. Then no other name is an area, and strangers displace no area. Otherwise
    the first ``MAX_NAMES`` areas are kept, with ``MOST_BYTES`` of messages, and ``MOST_AREAS`` are shown.
    ``is_linked``: the watcher has a link to the bus, by which all else comes.
    """

    run: str
    areas: frozenset[str] | None = None
    is_linked: bool = True
    _presence: Presence = field(default_factory=Presence)
    _strangers: Presence = field(default_factory=Presence)  # all processes but ``areas``, if these are known
    _other_versions: dict[int, Presence] = field(default_factory=dict)
    _shown: dict[str, None] = field(default_factory=dict)  # areas whose tokens are or were present
    _leave_reasons: dict[str, str] = field(default_factory=dict)
    _received: dict[str, tuple[float, StateMessage]] = field(default_factory=dict)
    _first_received: dict[str, float] = field(default_factory=dict)  # area -> time of its first state
    _longest_pause: dict[str, float] = field(default_factory=dict)  # between two states of an area's incarnation, s
    _noted: dict[str, tuple[Noted, ...]] = field(default_factory=dict)  # of an area's last state
    _vanished: dict[tuple[str, str], float | None] = field(default_factory=dict)  # role and name of absent ones -> when
    _readings: dict[str, ReadingsMessage] = field(default_factory=dict)
    _sizes: dict[tuple[str, str], int] = field(default_factory=dict)  # area and kind of message -> bytes, and
    _bytes: int = 0  # their sum

    def copy(self) -> Watcher:
        """An independent watcher with the same knowledge; messages are shared, as they never change."""
        own = (field for field in fields(self) if field.name not in ("run", "areas"))
        return replace(self, **{field.name: _copy(getattr(self, field.name)) for field in own})

    def take_presence(self, key: str, alive: bool, now: float | None = None) -> None:
        """Note that a token of any wire version appeared or vanished; ``now``: when, if that is known."""
        if (version := version_of(key)) != WIRE_VERSION:
            if version in self._other_versions or len(self._other_versions) < MOST_VERSIONS:
                self._other_versions.setdefault(version, Presence()).take(key, alive)
            return
        role, name = name_of_live(key)
        if not self._presence_of(key).take(key, alive):
            return
        self._note_vanished(role, name, alive, now)
        if alive and self._is_known(name):
            self._leave_reasons.pop(name, None)  # of its former incarnation
            if role == "area" and len(self._shown) < MAX_NAMES:
                self._shown[name] = None

    def _note_vanished(self, role: str, name: str, alive: bool, now: float | None) -> None:
        if alive:
            self._vanished.pop((role, name), None)
        elif role in VANISHING and len(self._vanished) < MAX_NAMES:
            self._vanished[role, name] = now

    def forget_presence(self) -> None:
        """Forget all tokens, since the links to the bus are opened again."""
        self._presence.forget()
        self._strangers.forget()
        self._shown.clear()
        self._other_versions.clear()

    def take_leave(self, key: str, leave_reason: str, now: float | None = None) -> None:
        """Note the leave message of a process; ``now``: when it came, if that is known."""
        role, name = name_of_live(key)
        was_there = self._presence_of(key).has(role, name)
        is_gone = self._presence_of(key).take_leave(key) and self._is_known(name)
        if was_there and not self._presence_of(key).has(role, name):
            self._note_vanished(role, name, False, now)
        if is_gone and len(self._leave_reasons) < MAX_NAMES:
            self._leave_reasons[name_of_live(key)[1]] = leave_reason

    def has_place_for(self, area: str) -> bool:
        """True where messages of ``area`` are kept: it is a known area, or among the first that were received."""
        if self.areas is not None:
            return area in self.areas
        return area in self._received or len(self._received) < MAX_NAMES

    def take_state(self, state: StateMessage, now: float, size: int = 0) -> bool:
        """Keep ``state`` if it is of this run and as new as the area's last, or the last one's incarnation is over.

        ``size``: bytes of the message. Returns True where it is kept.
        """
        area = state.header.sender
        at, last = self._received.get(area, (now, state))
        if not self.has_place_for(area) or state.header.run != self.run:
            return False
        is_outdated = is_old(state.header.order, last.header.order, now - at, self._silent_after_s(area))
        if is_outdated or not self._has_room(area, state.kind, size):
            return False
        same_incarnation = state.header.incarnation == last.header.incarnation
        self._longest_pause[area] = max(now - at, self._longest_pause.get(area, 0.0)) if same_incarnation else 0.0
        if area not in self._received or (state.notes, state.removed) != (last.notes, last.removed):
            self._noted[area] = read_notes(state.notes, state.removed, self._noted.get(area), now)
        self._received[area] = (now, state)
        self._first_received.setdefault(area, now)
        return True

    def _silent_after_s(self, area: str) -> float:
        """Time without a state of ``area``, s, after which it is silent and its incarnation over."""
        return max(OVER_S, SILENT_PAUSES * self._longest_pause.get(area, 0.0))

    def is_silent(self, area: str, now: float) -> bool:
        """True where a state of ``area`` was received, and none for long."""
        return area in self._received and self.age_of(area, now) > self._silent_after_s(area)

    def age_of(self, area: str, now: float) -> float:
        """Time since the last state of ``area`` was received, s; infinite where none was."""
        return now - self._received[area][0] if area in self._received else math.inf

    def take_readings(self, readings: ReadingsMessage, size: int = 0) -> None:
        """Keep the readings that an area has used last; ``size``: bytes of the message.

        Readings of the incarnation whose state is kept take the place of those of another: a clock may have been set
        back between the two.
        """
        area, known = readings.header.sender, self._readings.get(readings.header.sender)
        is_too_much = known is None and len(self._readings) >= MAX_NAMES
        if readings.header.run != self.run or is_too_much or not self._is_known(area):
            return
        is_newer = known is None or readings.header.order >= known.header.order
        if known is not None and readings.header.incarnation != known.header.incarnation and area in self._received:
            is_newer = is_newer or readings.header.incarnation == self._received[area][1].header.incarnation
        if is_newer and self._has_room(area, readings.kind, size):
            self._readings[area] = readings

    def _has_room(self, area: str, kind: str, size: int) -> bool:
        """True where a message of ``size`` bytes fits in place of the last of its kind; its bytes are then counted."""
        more = size - self._sizes.get((area, kind), 0)
        if self.areas is None and self._bytes + more > MOST_BYTES:
            return False
        self._sizes[area, kind], self._bytes = size, self._bytes + more
        return True

    def is_whole(self) -> bool:
        """True where areas are present, and a state of each has been received."""
        present = self.names_of("area")
        return bool(present) and present <= self._received.keys()

    def find_absent(self) -> tuple[str, ...]:
        """Areas that other areas send to, and that are not present."""
        addressed = {name for _, state in self._received.values() for name in state.sent}
        return tuple(sorted(addressed - self.names_of("area")))

    def state_of(self, area: str) -> StateMessage | None:
        """The last state of ``area``; None if none was received."""
        return self._received[area][1] if area in self._received else None

    @property
    def states(self) -> Mapping[str, StateMessage]:
        """Area -> its last state, for the areas that are shown."""
        return {area: self._received[area][1] for area in self._choose_received()}

    @property
    def readings(self) -> Mapping[str, ReadingsMessage]:
        """Area -> the readings that it has used last, for the areas that are shown."""
        if len(self._readings) <= self._most_areas:
            return self._readings
        return {area: self._readings[area] for area in self._choose_received() if area in self._readings}

    def look(self, now: float) -> View:
        """The view at ``now``."""
        present, received = self.names_of("area"), self._choose_received()
        addressed = {name for area in received for name in self._received[area][1].sent if self._is_known(name)}
        named = (present | addressed) - self._received.keys()
        room = self._most_areas - len(received)  # areas that are only named do not displace areas that were received
        names = sorted([*received, *sorted(named, key=_by_number)[:room]], key=_by_number)
        left_out = len(self._received) + len(named) - len(names)
        strangers = sum(role == "area" for role, _ in self._strangers.names) + left_out
        views = tuple(self._view_of(name, name in present or self._may_be_there(name, now), now) for name in names)
        duplicates = tuple(islice(self._find_duplicates(), MOST_DUPLICATES))
        others, more_others = self._find_others()
        gone = {f"{role} {name}": at for (role, name), at in sorted(self._vanished.items()) if role != "area"}
        versions = self.find_other_versions()
        return View(self.run, views, others, duplicates, versions, strangers, more_others, now, self.is_linked, gone)

    @property
    def _most_areas(self) -> int:
        return MOST_AREAS if self.areas is None else len(self.areas)

    def _choose_received(self) -> list[str]:
        """The received areas that are shown: areas with an estimate first, then in order of arrival."""
        if len(self._received) <= self._most_areas:
            return list(self._received)
        rank = {area: (not state.buses, not state.sent) for area, (_, state) in self._received.items()}
        return sorted(rank, key=rank.__getitem__)[: self._most_areas]

    def _find_others(self) -> tuple[tuple[str, ...], int]:
        """Present processes other than areas, as ``role name``, and the number of those left out."""
        found = [(role, name) for role, name in self._presence.names | self._strangers.names if role != "area"]
        ranked = sorted(found, key=lambda other: (other[0] not in ROLES, other))[:MOST_OTHERS]
        return tuple(sorted(f"{role} {name}" for role, name in ranked)), len(found) - len(ranked)

    def _is_known(self, area: str) -> bool:
        return self.areas is None or area in self.areas

    def _presence_of(self, key: str) -> Presence:
        """The ``Presence`` that keeps the token on ``key``."""
        role, name = name_of_live(key)
        return self._presence if self.areas is None or (role == "area" and name in self.areas) else self._strangers

    def find_other_versions(self) -> tuple[str, ...]:
        """Sentences that name the processes of each other wire version."""
        found = {
            version: sorted({f"{role} {name}" for role, name in presence.names})
            for version, presence in sorted(self._other_versions.items())
        }
        return tuple(
            describe_other_version(version, f"{listed(names, MOST_NAMED)} speak{'s' * (len(names) == 1)}")
            for version, names in found.items()
            if names
        )

    def _find_duplicates(self) -> Iterator[str]:
        for presence in (self._presence, self._strangers):
            for role, name in sorted(presence.names):
                incarnations = presence.incarnations_of(role, name)
                if role in NOUNS and len(incarnations) > 1:
                    yield describe_duplicate(role, name, tuple(map(str, incarnations)))

    def is_present(self, area: str) -> bool:
        """True where a token of ``area`` is there."""
        return self._presence.has("area", area)

    def names_of(self, role: str) -> set[str]:
        """Names of the present processes of ``role``."""
        return {name for its_role, name in self._presence.names if its_role == role}

    def _may_be_there(self, area: str, now: float) -> bool:
        """True where ``area`` was first received within OVER_S, and the answer about its token has not come yet."""
        is_known_by_states = self.areas is None and area in self._received and area not in self._shown
        return is_known_by_states and now - self._first_received[area] <= OVER_S

    def _view_of(self, name: str, present: bool, now: float) -> AreaView:
        leave_reason = "" if present else self._leave_reasons.get(name, "")
        if name not in self._received:
            silence = f"has left: {leave_reason}" if leave_reason else "" if present else "is gone"
            vanished = None if present else self._vanished.get(("area", name))
            notes = assess_from_outside(None, silence).notes
            return AreaView(name, present, None, leave_reason, notes=notes, vanished=vanished)
        at, state = self._received[name]
        is_silent = self.is_silent(name, now)
        meetings = {other: meeting for other in state.sent if (meeting := self._meeting(state, other))}
        silence = f"has sent nothing for {now - at:.1f} s" if is_silent else ""
        if not present:
            silence = f"has left: {leave_reason}" if leave_reason else "is gone"
        assessment = assess_from_outside(state, silence)
        return AreaView(
            name=name,
            present=present,
            age_s=round(now - at, 3),
            leave_reason=leave_reason,
            scan=state.header.scan,
            quality=assessment.quality,
            said_quality=state.quality,
            silent=is_silent,
            silent_after_s=self._silent_after_s(name),
            telemetry_age_s=round(state.telemetry_age + now - at, 3),
            ages_s={other: round(age + now - at, 3) for other, age in state.ages.items()},
            lowest_vm=_extreme(state, min((vm for vm in state.vm if vm), default=None)),  # 0: without supply
            highest_vm=_extreme(state, max(state.vm, default=None)),
            worst_meter=_find_worst(self._readings.get(name), state),
            oldest_reading_s=round(state.oldest_reading + now - at, 3),
            clock_skews_s=state.clock_skews,
            objective=state.objective,
            degrees_of_freedom=state.degrees_of_freedom,
            critical=state.critical,
            meters_off=state.meters_off,
            switches=state.switches,
            estimated=bool(state.buses),
            referenced=state.referenced,
            checked=state.checked,
            neighbours=tuple(state.sent),
            mismatch_vm_pu=max((m.vm for m in meetings.values() if m.vm is not None), default=None),
            mismatch_va_deg=max((math.degrees(m.va) for m in meetings.values() if m.va is not None), default=None),
            exchanges=count_exchanges(state),
            messages=state.messages,
            bytes=state.bytes,
            lost=state.lost,
            removed=state.removed,
            rejected=state.rejected,
            notes=assessment.notes,
            split=state.split.digest,
            split_time=state.split.time,
            split_edited=state.split.edited,
            next_split=state.next_split.digest,
            meetings=meetings,
            noted=self._noted.get(name, ()),
            vanished=None if present else self._vanished.get(("area", name)),
        )

    def _meeting(self, state: StateMessage, other: str) -> Meeting | None:
        """The meeting of an area with a neighbour; None without a common bus."""
        theirs = self._received[other][1] if other in self._received else None
        buses = tuple(sorted(set(state.buses) & set(theirs.buses))) if theirs else ()
        if theirs is None or not buses:
            return None
        differences = find_mismatches(buses, state, theirs)
        if theirs.header.scan != state.header.scan or not differences:
            return Meeting(buses, str(buses[0]))
        nodes, (vm, va) = list(differences), zip(*differences.values(), strict=True)
        if not (state.referenced and theirs.referenced):
            return Meeting(buses, name_node(*nodes[vm.index(max(vm))]), max(vm))
        larger = vm if max(vm) >= max(va) else va
        return Meeting(buses, name_node(*nodes[larger.index(max(larger))]), max(vm), max(va))


def count_exchanges(state: StateMessage) -> int:
    """The largest number of changed messages that an area has sent to one neighbour; they are numbered from 1."""
    return max((load + boundary for load, boundary in state.sent.values()), default=0)


def _copy(kept: Any) -> Any:
    match kept:
        case Presence():
            return kept.copy()
        case dict():
            return {key: _copy(value) for key, value in kept.items()}
    return kept


def _extreme(state: StateMessage, vm: float | None) -> Extreme | None:
    """The first node with magnitude ``vm``."""
    return None if vm is None else Extreme(vm, name_node(*state.nodes[state.vm.index(vm)]))


def _find_worst(readings: ReadingsMessage | None, state: StateMessage) -> Extreme | None:
    """The meter in use with the largest normalised residual; None unless ``readings`` are of the state's scan."""
    if readings is None or readings.header.scan != state.header.scan:
        return None
    off = np.array(readings.normalised, dtype=float)
    if np.isnan(off).all():  # also where it is empty
        return None
    worst = int(np.nanargmax(off))
    return Extreme(readings.normalised[worst], readings.meters[worst])


def _by_number(name: str) -> tuple[str, int]:
    """Key of an order in which area2 comes before area10."""
    word = name.rstrip("0123456789")
    return word, int(name[len(word) :] or 0)
