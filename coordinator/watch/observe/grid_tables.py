"""Tables of the states and readings that areas publish: in the units of engineers with a scenario, else in p.u."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from agents.messages.packing import ReadingsMessage, StateMessage
from coordinator.watch.observe.area_flows import add_problems
from coordinator.watch.observe.freshness import NOT_KNOWN, describe_freshness
from coordinator.watch.observe.mismatch import find_mismatches
from coordinator.watch.observe.switches import find_statuses
from coordinator.watch.observe.view import View
from coordinator.watch.observe.watcher import Watcher
from dsse_core.grid.measurement import Meter, Source
from dsse_core.grid.partition import Partition
from dsse_core.grid.switches import find_dead_meters
from dsse_core.results.branches import find_loading, make_branch_table
from dsse_core.results.buses import make_bus_table
from dsse_core.results.flows import Flows, build_branch_model
from dsse_core.results.meters import DEAD, find_unit_sizes
from dsse_core.results.state import AreaVoltages, join_states
from dsse_core.results.table import ALL_PHASES, Freshness, Table
from dsse_core.results.totals import division_of
from dsse_core.results.units import wrap_degrees
from scenarios.scenario import Scenario

States = Mapping[str, StateMessage]
ReadingsByArea = Mapping[str, ReadingsMessage]
FreshnessByArea = Mapping[str, Freshness]
Columns = dict[str, Any]  # name -> column of a table: array of numbers, list or tuple of texts
RELATIVE = "age_s", "residual_in_sigmas", "normalised_residual"  # columns without a unit of the meter
USED, REMOVED, CRITICAL, SILENT, OFF = "used", "removed", "critical", "silent", "off"
UNKNOWN = "not received"  # the readings of its area, for up to 10 s after a watcher begins to listen


class Tables(NamedTuple):
    """The tables of a moment. ``branches``: None where the grid is not known."""

    buses: Table
    branches: Table | None
    meters: Columns


def find_tables(watcher: Watcher, view: View, known: GridTables | None) -> Tables:
    """Tables of the messages that ``watcher`` has received, whose numbers have the freshness of ``view``.

    ``known``: the grid, if its scenario is known.
    """
    states, readings, freshness = watcher.states, watcher.readings, view.freshness
    if known is None:
        return Tables(list_buses(states, freshness), None, collect_readings(states, readings, freshness))
    known = known.operated(find_statuses(known.partition, states))
    return Tables(*known.buses_and_branches(states, freshness), known.collect_meters(states, readings, freshness))


def list_buses(states: States, freshness: FreshnessByArea) -> Table:
    """A row for each node of each area, p.u. and degrees; a boundary bus has rows for each area that sees it."""
    rows = [
        (area, *node, vm, va if s.referenced else np.nan, sigma_vm, np.degrees(sigma_va))
        for area, s in states.items()
        for node, vm, va, sigma_vm, sigma_va in zip(s.nodes, s.vm, s.va, s.sigma_vm, s.sigma_va, strict=True)
    ]
    areas, buses, phases, *numbers = zip(*rows, strict=True) if rows else [()] * 7
    names = "vm_pu", "va_deg", "sigma_vm_pu", "sigma_va_deg"
    columns = {name: np.array(column, dtype=float) for name, column in zip(names, numbers, strict=True)}
    columns["va_deg"] = wrap_degrees(columns["va_deg"])
    node: Columns = {"bus": np.array(buses, dtype=np.int64), "area": areas, "phase": [p or ALL_PHASES for p in phases]}
    return Table("buses", node | columns | describe_freshness(areas, freshness))


def collect_readings(states: States, readings: ReadingsByArea, freshness: FreshnessByArea) -> Columns:
    """Columns of the meters that areas have used, or that are off, in their last scans; p.u. and rad. No table, which
    takes longer.

    ``residual_in_sigmas``: (reading - estimate) / standard deviation of the reading. ``normalised_residual``:
    |reading - estimate| / standard deviation of the residual. Both are nan where not known, as for a meter that is off.
    ``age_s``: age of the reading at the tick of the scan.
    """
    found = _collect(states, readings)
    return found | describe_freshness(found["area"], freshness)


def _collect(states: States, readings: ReadingsByArea) -> Columns:
    texts: dict[str, list[str]] = {name: [] for name in ("meter", "area", "status")}
    names = "reading", "sigma", "estimate", "normalised_residual", "age_s"
    numbers: dict[str, list[float]] = {name: [] for name in names}
    for area, used in readings.items():
        state = states.get(area)
        known = {*used.meters} if state is not None and state.meters_off else frozenset[str]()
        missing = [meter for meter in state.meters_off if meter not in known] if state is not None else []
        unknown = (math.nan,) * (len(used.meters) - len(used.estimates))
        status, gap = _status_of(state), [math.nan] * len(missing)
        texts["meter"] += (*used.meters, *missing)
        texts["area"] += [area] * (len(used.meters) + len(missing))
        texts["status"] += [status.get(meter, USED) for meter in used.meters] if status else [USED] * len(used.meters)
        texts["status"] += [OFF] * len(missing)
        numbers["reading"] += (*used.values, *gap)
        numbers["sigma"] += (*used.sigmas, *gap)
        numbers["estimate"] += (*used.estimates, *unknown, *gap)
        numbers["normalised_residual"] += (*used.normalised, *unknown, *gap)
        numbers["age_s"] += (used.taken_at - np.array(used.times, dtype=float)).clip(0.0).tolist() + gap
    found = {name: np.array(column, dtype=float) for name, column in numbers.items()}
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # values of a hostile area
        found["residual_in_sigmas"] = (found["reading"] - found["estimate"]) / found["sigma"]
    return {**texts, **found}


def worst_first(meters: Table) -> Table:
    """The same rows, the largest normalised residual first; unknown residuals come last."""
    columns = {name: meters[name] for name in meters.columns}
    return Table("meters", pick_rows(columns, order_worst_first(columns)))


def order_worst_first(meters: Columns, most: int | None = None) -> np.ndarray:
    """Row numbers in the order of ``worst_first``, the first ``most`` of them."""
    order = -meters["normalised_residual"]
    found = np.arange(len(order))
    if most is not None and most < len(order) and not np.isnan(last := np.partition(order, most)[most]):
        found = np.flatnonzero(order <= last)
    return found[np.argsort(order[found], kind="stable")][:most]  # nan last


def pick_rows(columns: Columns, rows: np.ndarray) -> Columns:
    """The values of ``columns`` in some ``rows``."""
    return {n: c[rows] if isinstance(c, np.ndarray) else [c[k] for k in rows.tolist()] for n, c in columns.items()}


def _status_of(state: StateMessage | None) -> dict[str, str]:
    if state is None:
        return {}
    return dict.fromkeys(state.critical, CRITICAL) | dict.fromkeys(state.removed, REMOVED)


@dataclass(frozen=True)
class _MeterRows:
    """Parts of a table of meters that stay the same while the same meters have readings.

    ``of``: meters and areas of the readings. ``known``: rows of the readings whose meters are in the scenario;
    ``are_all``: True if all are. ``size``: sizes of the units of these meters. ``silent_areas``: areas of the meters
    without a reading. ``columns``: of the meters in ``known``, then of those without a reading. ``dead``: rows there of
    those without supply.
    """

    of: tuple[list[str], list[str]]
    known: np.ndarray
    are_all: bool
    size: np.ndarray
    silent_areas: list[str]
    columns: Mapping[str, Any]
    dead: np.ndarray


@dataclass(frozen=True)
class GridTables:
    """Tables of the grid of ``scenario``, with the columns of a run's results, in kV, kW, kvar, A and degrees."""

    scenario: Scenario
    _last_rows: list[_MeterRows] = field(default_factory=list, repr=False, compare=False)
    _last_order: dict[str, tuple[object, np.ndarray]] = field(default_factory=dict, repr=False, compare=False)
    _last_operated: list[tuple[object, GridTables]] = field(default_factory=list, repr=False, compare=False)

    def operated(self, closed: Mapping[str, bool]) -> GridTables:
        """Tables of the grid with switches as in ``closed``; kept until the statuses change."""
        if closed.items() <= self.scenario.network.switches.items():
            return self
        if not self._last_operated or self._last_operated[0][0] != closed:
            self._last_operated[:] = [(dict(closed), GridTables(self.scenario.operated(closed)))]
        return self._last_operated[0][1]

    @property
    def partition(self) -> Partition:
        return self.scenario.partition

    @cached_property
    def is_rated(self) -> np.ndarray:
        """True for conductors whose loading can be known, (n_row,)."""
        branches = build_branch_model(self.scenario.network)
        none = np.zeros(len(branches.branch), dtype=complex)
        return np.asarray(~np.isnan(find_loading(branches, Flows(none, none, none, none))))

    def buses_and_branches(self, states: States, freshness: FreshnessByArea) -> tuple[Table, Table]:
        """Buses by the states of their owners, branches by those of the areas that hold them; nan where not known.

        ``injection_problem``: the reason that the injection of a boundary bus is not known, empty if it is.
        """
        fitting = {area.name: own for area in self.partition.areas if (own := self._fitting(area.name, states))}
        state = join_states(self.partition, {name: self._voltages_of(name, s) for name, s in fitting.items()})
        n, owners, of_node = len(state.vm), self.partition.owner_of_bus, state.network.table.nodes.item
        sigma = np.full((2, n), np.nan)
        for k, area in enumerate(self.partition.areas):
            if (own := fitting.get(area.name)) is not None:
                rows, order = self.partition.rows_of_nodes[area.name], self._order_of(area.name, own)
                owned = self.partition.owner[of_node[rows]] == k
                sigma[0, rows[owned]] = np.array(own.sigma_vm)[order][owned]
                if own.referenced:
                    sigma[1, rows[owned]] = np.array(own.sigma_va)[order][owned]
        areas = [owners[bus] for bus in state.network.node_buses]
        problems = self._find_injection_problems(fitting, freshness)
        unknown = np.isin(state.network.table.bus_id, list(problems))[of_node]
        state = replace(state, injection=np.where(unknown, complex(np.nan, np.nan), state.injection))
        marks, unknown = describe_freshness(areas, freshness), np.full((2, n), np.nan)
        buses = make_bus_table(state, areas, {}, sigma[0], sigma[1], unknown, marks=marks)
        holders = self._holders
        marks = describe_freshness([holders[k] for k in state.branches.branch.tolist()], freshness)
        branches = make_branch_table(state, marks=marks)
        return add_problems(buses, problems), branches

    @cached_property
    def _holders(self) -> list[str]:
        """The area of each branch; of an open one, that of its from bus."""
        division = division_of(self.partition)
        return [division.names[k] for k in division.of_branch.tolist()]

    def _find_injection_problems(self, states: States, freshness: FreshnessByArea) -> dict[int, str]:
        """Boundary bus -> the reason that the parts of its injection in several areas do not add up."""
        found: dict[int, str] = {}
        limits = self.scenario.tolerances.consensus_vm_pu, self.scenario.tolerances.consensus_va_rad
        for bus, (owner, *others) in self.partition.boundaries.items():
            seen = [states.get(name) for name in (owner, *others)]
            fresh = [freshness.get(name, NOT_KNOWN).fresh for name in (owner, *others)]
            for name, state, is_fresh in zip((owner, *others), seen, fresh, strict=True):
                if state is None or seen[0] is None:
                    found.setdefault(bus, f"{owner if seen[0] is None else name} has no estimate")
                elif fresh[0] and not is_fresh:
                    found.setdefault(bus, f"the numbers of {name} are old")
                elif state.header.scan != seen[0].header.scan:
                    found.setdefault(bus, f"{owner} and {name} are of different scans")
                elif not _agree_at(bus, seen[0], state, *limits):
                    found.setdefault(bus, f"{owner} and {name} differ there")
        return found

    def collect_meters(self, states: States, readings: ReadingsByArea, freshness: FreshnessByArea) -> Columns:
        """Columns of ``collect_readings`` with readings in their ``unit``, and a row for each meter without a reading.

        The status of such a meter is ``silent`` where its area has published its readings, else ``not received``; that
        of one without supply ``silent: dead``.
        """
        plain = _collect(states, readings)
        rows = self._find_rows(plain["meter"], plain["area"])
        gap = np.full(len(rows.silent_areas), np.nan)
        status = [*plain["status"]] if rows.are_all else [plain["status"][k] for k in rows.known.tolist()]
        status += [SILENT if area in readings else UNKNOWN for area in rows.silent_areas]
        for row in rows.dead.tolist():
            status[row] = DEAD
        sized = "reading", "sigma", "estimate"
        with np.errstate(over="ignore"):
            scaled = {name: np.concatenate([plain[name][rows.known] * rows.size, gap]) for name in sized}
        relative = {name: np.concatenate([plain[name][rows.known], gap]) for name in RELATIVE}
        fresh = describe_freshness(rows.columns["area"], freshness)
        return {**rows.columns, "status": status, **scaled, **relative, **fresh}

    def _find_rows(self, meters: list[str], areas: list[str]) -> _MeterRows:
        """The rows for these readings; computed again only where other meters have readings than at the last call."""
        last = self._last_rows[0] if self._last_rows else None
        if last is not None and last.of == (meters, areas):
            return last
        known = [k for k, meter in enumerate(meters) if meter in self._meters]
        listed = [self._meters[meters[k]] for k in known]
        present = set(meters)
        silent = [name for name in self._telemetered if name not in present]
        silent_areas = [self._area_of_meter.get(name, "") for name in silent]
        all_meters = [*listed, *(self._meters[name] for name in silent)]
        is_balanced = self.scenario.network.table.nodes.is_balanced
        columns = {
            "meter": tuple(meter.id for meter in all_meters),
            "area": (*(areas[k] for k in known), *silent_areas),
            "bus": np.array([meter.bus for meter in all_meters], dtype=np.int64),
            "branch": tuple(meter.branch or "" for meter in all_meters),
            **({} if is_balanced else {"phase": tuple(meter.phases or ALL_PHASES for meter in all_meters)}),
            "unit": tuple(meter.kind.quantity.unit for meter in all_meters),
        }
        size, are_all = find_unit_sizes(self.scenario.network, listed), len(known) == len(meters)
        dead = np.flatnonzero(find_dead_meters(self.scenario.network, all_meters))
        rows = _MeterRows((meters, areas), np.array(known, dtype=np.int64), are_all, size, silent_areas, columns, dead)
        self._last_rows[:] = [rows]
        return rows

    @cached_property
    def _meters(self) -> dict[str, Meter]:
        return {meter.id: meter for meter in self.scenario.meters}

    @cached_property
    def _telemetered(self) -> list[str]:
        """Ids of the meters that can have a reading."""
        return [name for name, meter in self._meters.items() if meter.source is not Source.VIRTUAL]

    @cached_property
    def _area_of_meter(self) -> dict[str, str]:
        by_area = self.partition.meters_by_area(self.scenario.meters)
        return {meter.id: area for area, own in by_area.items() for meter in own}

    def _fitting(self, area: str, states: States) -> StateMessage | None:
        """The state of ``area`` if its nodes are the area's; None for an estimate of other nodes, or none."""
        state = states.get(area)
        own = self.partition.area(area).network.nodes
        return state if state is not None and state.buses and set(own) == set(state.nodes) else None

    def _order_of(self, area: str, state: StateMessage) -> np.ndarray:
        """Position in the area's ``state`` of each node of its network, (n_nodes,)."""
        at = state.buses, state.phases
        if self._last_order.get(area, ((), None))[0] != at:
            place = {node: k for k, node in enumerate(state.nodes)}
            found = [place[node] for node in self.partition.area(area).network.nodes]
            self._last_order[area] = at, np.array(found, dtype=np.int64)
        return self._last_order[area][1]

    def _voltages_of(self, area: str, state: StateMessage) -> AreaVoltages:
        order = self._order_of(area, state)
        vm, va = (np.array(of)[order] for of in (state.vm, state.va))
        return AreaVoltages(vm, va, state.referenced, state.header.scan, state.taps)


def _agree_at(bus: int, one: StateMessage, other: StateMessage, most_vm: float, most_va: float) -> bool:
    """True where two areas state the same voltages of the phases of ``bus`` that both have, of angles that count from
    the substation in both.
    """
    both, differences = one.referenced and other.referenced, find_mismatches([bus], one, other).values()
    return all(vm <= most_vm and (va <= most_va or not both) for vm, va in differences)
