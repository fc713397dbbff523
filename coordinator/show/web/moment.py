"""One moment of a run as the page and the API show it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from agents.protocol.quality import GOOD, QUALITIES
from coordinator.show.web.history import History
from coordinator.show.web.shown_tables import draw_tables
from coordinator.watch.observe.causes import Onsets, find_causes
from coordinator.watch.observe.grid_tables import (
    Columns,
    GridTables,
    Tables,
    collect_readings,
    find_tables,
    list_buses,
)
from coordinator.watch.observe.summary import summarise
from coordinator.watch.observe.view import AreaView, View
from coordinator.watch.observe.view_json import describe_causes, describe_summary, describe_view
from coordinator.watch.observe.watcher import Watcher
from dsse_core.estimation.state_limits import DEFAULT_OPERATING_LIMITS
from dsse_core.results.table import Table

MOST_EVENTS = 200

Links = Sequence[Mapping[str, Any]]
"""Of ``find_links``."""


@dataclass(frozen=True, slots=True)
class _Link:
    """The last known condition of a link."""

    is_dead: bool = False  # False also for a link that has not begun to work
    has_worked: bool = False


@dataclass
class Events:
    """Events: changes from one view to the next, in words. ``kept``: the newest ones.

    ``scan_s``: time between the last two scans, s; None before the second.
    """

    kept: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=MOST_EVENTS))
    scan_s: float | None = None
    _scan: tuple[int, float] = (0, 0.0)  # the newest, and when it was first seen
    _before: dict[str, AreaView] = field(default_factory=dict)
    _links: dict[tuple[str, str], _Link] = field(default_factory=dict)  # sender first

    def take(self, at: float, view: View, links: Links) -> None:
        """Adds an event for each difference from the last view and its links, see ``find_links``."""
        for area in view.areas:
            before = self._before.get(area.name)
            for kind, text in _find_changes(before, area):
                self.kept.append({"time": at, "area": area.name, "kind": kind, "text": text})
        seen = {area.name: area for area in view.areas}
        for name, before in self._before.items():
            if name not in seen and before.present:
                self.kept.append({"time": at, "area": name, "kind": "vanished", "text": "is gone"})
        self._before = seen
        self._take_links(at, view, links)
        (last, since), newest = self._scan, max((area.scan for area in view.areas), default=0)
        if newest > last:
            self.scan_s = (at - since) / (newest - last) if last else None
            self._scan = newest, at

    def _take_links(self, at: float, view: View, links: Links) -> None:
        """Adds an event for each link that stops working, that does not work although its receiver estimates, or that
        works after either. Links of an area that is absent or silent have no events; the area has its own.
        """
        there = {area.name: area for area in view.areas if area.present and not area.silent}
        before, self._links = self._links, {}
        for link in links:
            sender, receiver, works = link["from"], link["to"], link["alive"]
            known = before.get((sender, receiver), _Link())
            is_reported = there.keys() >= {sender, receiver} and (known.has_worked or there[receiver].estimated)
            if is_reported and works == known.is_dead:
                text = f"receives nothing from {sender}"
                if works:
                    text = f"receives from {sender}{' again' if known.has_worked else ''}"
                self.kept.append({"time": at, "area": receiver, "kind": "link", "text": text})
            is_dead = not works and (is_reported or known.is_dead or known.has_worked)
            self._links[sender, receiver] = _Link(is_dead, known.has_worked or works)


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
    for switch, status in area.switches.items():
        if before is not None and before.switches.get(switch, status) != status:
            yield "switch", f"{switch} is {status}"


class Moments:
    """Makes moments from the messages that a watcher has received, and keeps their past.

    ``known``: the grid, if its scenario is known. ``onsets``: of the looks before; without them, as for a single
    moment, the time since when the grid is beyond a limit is not known.
    """

    def __init__(self, known: GridTables | None, onsets: Onsets | None = None) -> None:
        self.known = known
        self.onsets = onsets
        self.history = History(has_phases=known is not None and not known.scenario.network.table.nodes.is_balanced)
        self.events = Events()
        self.tables = Tables(list_buses({}, {}), None, collect_readings({}, {}, {}))  # of the last moment
        self._scans_kept: object = None

    def note(self, watcher: Watcher, now: float, at: float) -> View:
        """The view at ``now`` on the watcher's clock. Events and past take in its changes with the time ``at``, s."""
        view = watcher.look(now)
        self._note(at, view, find_links(view), lambda: find_tables(watcher, view, self.known))
        return view

    def _note(self, at: float, view: View, links: Links, find_tables: Callable[[], Tables]) -> None:
        self.events.take(at, view, links)
        scans = tuple((area.name, area.scan, area.quality) for area in view.areas)
        if scans != self._scans_kept:
            self._scans_kept = scans
            self._keep(at, view, find_tables())

    def make(self, watcher: Watcher, now: float, at: float, **more: Any) -> dict[str, Any]:
        """The moment at ``now``, see ``note``: the drawn columns of nodes and conductors, and the worst meters.

        ``more``: further keys, which replace those of the moment.
        """
        view = watcher.look(now)
        tables = find_tables(watcher, view, self.known)
        links = find_links(view)
        self._note(at, view, links, lambda: tables)
        self.tables, summary = tables, summarise(tables, self.known)
        causes = find_causes(view, at, summary)
        limits = self.known.scenario.operating_limits if self.known else DEFAULT_OPERATING_LIMITS
        return {
            "causes": describe_causes(self.onsets.date(causes, at) if self.onsets else causes),
            "at": at,
            "view": describe_view(view),
            "summary": describe_summary(summary),
            **draw_tables(tables, limits, has_grid=self.known is not None),
            "links": links,
            "events": list(self.events.kept),
            "scan_s": self.events.scan_s,
            "messages": [],
            "has_messages": False,
            **more,
        }

    def _keep(self, at: float, view: View, tables: Tables) -> None:
        """Keeps the fresh numbers; the past of others has a gap."""
        of, (buses, branches, meters) = self.history.of, tables
        ids = tuple(zip(buses.bus.tolist(), buses.phase, strict=True))
        of["bus"].take(at, ids, _find_fresh(buses, of["bus"].columns))
        if branches is not None:
            ids = tuple(zip(branches.branch, branches.phase, strict=True))
            of["branch"].take(at, ids, _find_fresh(branches, of["branch"].columns))
        of["meter"].take(at, meters["meter"], _find_fresh(meters, of["meter"].columns))
        fresh = [area if area.freshness.fresh else AreaView(area.name, area.present, None) for area in view.areas]
        areas = {
            "quality": [_number_quality(area.quality) for area in view.areas],
            "lowest_vm_pu": [np.nan if area.lowest_vm is None else area.lowest_vm.value for area in fresh],
            "highest_vm_pu": [np.nan if area.highest_vm is None else area.highest_vm.value for area in fresh],
            "messages": [area.messages for area in view.areas],
            "lost": [area.lost for area in view.areas],
        }
        columns = {name: np.array(column, dtype=float) for name, column in areas.items()}
        of["area"].take(at, [area.name for area in view.areas], columns)


def _find_fresh(columns: Columns | Table, names: Iterable[str]) -> dict[str, np.ndarray]:
    return {name: np.where(columns["fresh"], columns[name], np.nan) for name in names}


def encode_json(content: object) -> bytes:
    """``content`` as JSON; nan and infinity become null."""
    return msgspec.json.encode(content)


def _number_quality(quality: str) -> int:
    """Number of a quality: 0 is good, larger is worse; an unknown word has the largest number."""
    return QUALITIES.index(quality) if quality in QUALITIES else len(QUALITIES)


def find_links(view: View) -> list[dict[str, Any]]:
    """Links between neighbouring areas, one for each direction.

    ``age_s``: age of the last message, as the receiver reports it. ``alive``: True where both areas are present, the
    receiver is not silent, and the age is below its limit.
    """
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
