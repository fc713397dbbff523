"""One moment of a run as the page and the API show it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from agents.protocol.quality import GOOD, QUALITIES
from coordinator.observe.grid_tables import GridTables, list_buses, list_meters
from coordinator.observe.view import AreaView, View
from coordinator.observe.view_json import describe_view
from coordinator.observe.watch import Watcher
from coordinator.web.history import History
from dsse_core.results.table import Table

MOST_EVENTS = 200
# column -> decimals: what a page can show, in a third of the bytes
BUS = {"vm_pu": 6, "va_deg": 5, "sigma_vm_pu": 7, "sigma_va_deg": 6, "p_kw": 3, "q_kvar": 3}
BRANCH = {"p_from_kw": 3, "q_from_kvar": 3, "i_from_a": 3, "loss_kw": 4, "loading_percent": 2}
METER = {"reading": 6, "sigma": 7, "estimate": 6, "residual_in_sigmas": 3, "normalised_residual": 3, "age_s": 1}
WORDS = ("meter", "area", "status", "unit")

Tables = tuple[Table, Table | None, Table]
"""Buses, branches where the grid is known, meters."""


@dataclass
class Events:
    """What has changed from one view to the next, in words; the newest are kept."""

    kept: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=MOST_EVENTS))
    _before: dict[str, AreaView] = field(default_factory=dict)
    _worked: dict[tuple[str, str], bool] = field(default_factory=dict)  # links, sender first, that have ever worked

    def take(self, at: float, view: View) -> None:
        """Note what differs from the last view."""
        for area in view.areas:
            before = self._before.get(area.name)
            for kind, text in _find_changes(before, area):
                self.kept.append({"time": at, "area": area.name, "kind": kind, "text": text})
        seen = {area.name: area for area in view.areas}
        for name, before in self._before.items():
            if name not in seen and before.present:
                self.kept.append({"time": at, "area": name, "kind": "vanished", "text": "is gone"})
        self._before = seen
        self._take_links(at, view)

    def _take_links(self, at: float, view: View) -> None:
        """Links that stop working, and those that work again; where an area is gone, its own events say so."""
        there = {area.name for area in view.areas if area.present and not area.silent}
        worked, self._worked = self._worked, {}
        for link in _find_links(view):
            ends, works = (link["from"], link["to"]), link["alive"]
            before = worked.get(ends)
            if before is not None and works != before and there.issuperset(ends):
                text = f"receives {'from' if works else 'nothing from'} {link['from']}{' again' if works else ''}"
                self.kept.append({"time": at, "area": link["to"], "kind": "link", "text": text})
            if works or before is not None:
                self._worked[ends] = works


def _find_changes(before: AreaView | None, area: AreaView) -> Iterable[tuple[str, str]]:
    if before is None or before.present != area.present:
        left = f" and left: {area.leave_reason}" if area.leave_reason else ""
        yield ("appeared", "is there") if area.present else ("vanished", f"is gone{left}")
    if before is None or before.quality != area.quality:
        yield "quality", f"{area.quality}{f': {area.notes[0]}' if area.notes and area.quality != GOOD else ''}"
    removed = before.removed if before else ()
    for meter in area.removed:
        if meter not in removed:
            yield "removed", f"{meter} is taken out as bad data"
    off = before.meters_off if before else ()
    if {*off} != {*area.meters_off}:
        yield "operator", f"meters off: {', '.join(area.meters_off) or 'none'}"


class Moments:
    """Makes moments of what a watcher has received, and keeps their past.

    ``known``: the grid, if there is a scenario of it.
    """

    def __init__(self, known: GridTables | None) -> None:
        self.known = known
        self.history = History()
        self.events = Events()
        self._scans_kept: object = None

    def note(self, watcher: Watcher, now: float, at: float) -> View:
        """What is seen ``now`` on the watcher's clock, called ``at`` (s); events and past take in what is new of it."""
        view = watcher.look(now)
        self._note(at, view, lambda: self._find_tables(watcher))
        return view

    def _note(self, at: float, view: View, find_tables: Callable[[], Tables]) -> None:
        self.events.take(at, view)
        scans = tuple((area.name, area.scan, area.quality) for area in view.areas)
        if scans != self._scans_kept:
            self._scans_kept = scans
            self._keep(at, view, *find_tables())

    def make(self, watcher: Watcher, now: float, at: float, **more: Any) -> dict[str, Any]:
        """The moment ``now``, see ``note``."""
        view, tables = watcher.look(now), self._find_tables(watcher)
        self._note(at, view, lambda: tables)
        buses, branches, meters = tables
        return {
            "at": at,
            "view": describe_view(view),
            "buses": _columns(buses, BUS) | {"id": buses.bus.tolist()},
            "branches": {} if branches is None else _columns(branches, BRANCH),
            "meters": _columns(meters, METER) | {name: meters[name] for name in WORDS if name in meters.columns},
            "links": _find_links(view),
            "events": list(self.events.kept),
            "messages": [],
            "has_messages": False,
            **more,
        }

    def _find_tables(self, watcher: Watcher) -> Tables:
        states, readings = watcher.states, watcher.readings
        if self.known is None:
            return list_buses(states), None, list_meters(states, readings)
        buses, branches = self.known.buses_and_branches(states)
        return buses, branches, self.known.meters(states, readings)

    def _keep(self, at: float, view: View, buses: Table, branches: Table | None, meters: Table) -> None:
        of = self.history.of
        of["bus"].take(at, buses.bus.tolist(), {name: buses[name] for name in of["bus"].columns})
        if branches is not None:
            of["branch"].take(at, branches.branch, {name: branches[name] for name in of["branch"].columns})
        of["meter"].take(at, meters.meter, {name: meters[name] for name in of["meter"].columns})
        areas = {
            "quality": [_number_quality(area.quality) for area in view.areas],
            "lowest_vm_pu": [np.nan if area.lowest_vm is None else area.lowest_vm.value for area in view.areas],
            "highest_vm_pu": [np.nan if area.highest_vm is None else area.highest_vm.value for area in view.areas],
            "messages": [area.messages for area in view.areas],
            "lost": [area.lost for area in view.areas],
        }
        columns = {name: np.array(column, dtype=float) for name, column in areas.items()}
        of["area"].take(at, [area.name for area in view.areas], columns)


def encode_json(content: object) -> bytes:
    """As JSON; nan and infinity are null."""
    return msgspec.json.encode(content)


def _number_quality(quality: str) -> int:
    """0 is good; a word that a stranger made up is the worst."""
    return QUALITIES.index(quality) if quality in QUALITIES else len(QUALITIES)


def _columns(table: Table, decimals: Mapping[str, int]) -> dict[str, Sequence[Any]]:
    """Those that the table has, rounded."""
    with np.errstate(over="ignore", invalid="ignore"):
        return {name: np.round(table[name], n).tolist() for name, n in decimals.items() if name in table.columns}


def _find_links(view: View) -> list[dict[str, Any]]:
    """Each boundary in each direction: whether the receiver says that it receives, and since when not."""
    present = {area.name: area for area in view.areas}
    return [
        {
            "from": other,
            "to": area.name,
            "age_s": area.ages_s.get(other),
            "alive": area.present
            and not area.silent
            and other in present
            and present[other].present
            and other in area.ages_s
            and area.ages_s[other] < area.silent_after_s,
        }
        for area in view.areas
        for other in area.neighbours
    ]
