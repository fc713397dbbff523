"""Tables of what areas publish: with the network in the units of its engineers, without it as far as the bus tells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from agents.messages.packing import ReadingsMessage, StateMessage
from dsse_core.grid.measurement import Meter, Source
from dsse_core.grid.partition import Partition
from dsse_core.results.branches import make_branch_table
from dsse_core.results.buses import make_bus_table
from dsse_core.results.meters import UNIT, find_unit_sizes
from dsse_core.results.state import AreaVoltages, join_states
from dsse_core.results.table import Table
from scenarios.scenario import Scenario

States = Mapping[str, StateMessage]
ReadingsByArea = Mapping[str, ReadingsMessage]
RELATIVE = "age_s", "residual_in_sigmas", "normalised_residual"  # columns without a unit of the meter
USED, REMOVED, CRITICAL, SILENT, OFF = "used", "removed", "critical", "silent", "off"
UNKNOWN = "not received"  # what its area has used: for up to 10 s after a watcher begins to listen


def list_buses(states: States) -> Table:
    """A row for each bus of each area, p.u. and degrees; a boundary bus has one for each area that sees it."""
    rows = [
        (area, bus, vm, np.degrees(va) if s.referenced else np.nan, sigma_vm, np.degrees(sigma_va))
        for area, s in states.items()
        for bus, vm, va, sigma_vm, sigma_va in zip(s.buses, s.vm, s.va, s.sigma_vm, s.sigma_va, strict=True)
    ]
    areas, buses, *numbers = zip(*rows, strict=True) if rows else [()] * 6
    names = "vm_pu", "va_deg", "sigma_vm_pu", "sigma_va_deg"
    columns = {name: np.array(column, dtype=float) for name, column in zip(names, numbers, strict=True)}
    return Table("buses", {"bus": np.array(buses, dtype=np.int64), "area": areas, **columns})


def list_meters(states: States, readings: ReadingsByArea) -> Table:
    """A row for each meter that an area has used, or left out, in its last scan; p.u. and rad.

    ``residual_in_sigmas``: reading - estimate in standard deviations of the reading, ``normalised_residual``: its
    magnitude in those of its own; nan where it is not known, as of a meter that is left out.
    ``age_s``: at the tick of the scan.
    """
    columns: dict[str, list[str]] = {name: [] for name in ("meter", "area", "status")}
    names = "reading", "sigma", "estimate", "normalised_residual", "age_s"
    numbers: dict[str, list[float]] = {name: [] for name in names}
    for area, used in readings.items():
        state = states.get(area)
        status = _status_of(state)
        unknown = (np.nan,) * (len(used.meters) - len(used.estimates))
        columns["meter"] += used.meters
        columns["area"] += [area] * len(used.meters)
        columns["status"] += [status.get(meter, USED) for meter in used.meters]
        numbers["reading"] += used.values
        numbers["sigma"] += used.sigmas
        numbers["estimate"] += (*used.estimates, *unknown)
        numbers["normalised_residual"] += (*used.normalised, *unknown)
        numbers["age_s"] += [max(0.0, used.taken_at - time) for time in used.times]
        if state is not None:
            missing = [meter for meter in state.meters_off if meter not in used.meters]
            columns["meter"] += missing
            columns["area"] += [area] * len(missing)
            columns["status"] += [OFF] * len(missing)
            for column in numbers.values():
                column += [np.nan] * len(missing)
    found = {name: np.array(column, dtype=float) for name, column in numbers.items()}
    with np.errstate(divide="ignore", invalid="ignore"):
        found["residual_in_sigmas"] = (found["reading"] - found["estimate"]) / found["sigma"]
    return Table("meters", {**columns, **found})


def worst_first(meters: Table) -> Table:
    """The same rows, the farthest from the estimate first; what is not known comes last."""
    order = np.argsort(-meters.normalised_residual, kind="stable")  # nan last
    columns = {name: meters[name] for name in meters.columns}
    return Table(
        "meters",
        {n: [c[k] for k in order.tolist()] if isinstance(c, tuple) else c[order] for n, c in columns.items()},
    )


def _status_of(state: StateMessage | None) -> dict[str, str]:
    if state is None:
        return {}
    return dict.fromkeys(state.critical, CRITICAL) | dict.fromkeys(state.removed, REMOVED)


@dataclass(frozen=True)
class GridTables:
    """Tables of a grid that is known: the same columns as everywhere else, in kV, kW, kvar, A and degrees."""

    scenario: Scenario

    @property
    def partition(self) -> Partition:
        return self.scenario.partition

    def buses_and_branches(self, states: States) -> tuple[Table, Table]:
        """A bus is as its owner says, a branch as the area that holds it; what is not known is nan."""
        fitting = {area.name: said for area in self.partition.areas if (said := self._fitting(area.name, states))}
        state = join_states(self.partition, {name: self._voltages_of(name, s) for name, s in fitting.items()})
        n, owners = len(state.vm), self.partition.owner_of_bus
        sigma = np.full((2, n), np.nan)
        for name, said in fitting.items():
            for bus, vm, va in zip(said.buses, said.sigma_vm, said.sigma_va, strict=True):
                if owners[bus] == name:
                    sigma[:, state.network.row[bus]] = vm, va if said.referenced else np.nan
        areas = [owners[bus.id] for bus in state.network.buses]
        buses = make_bus_table(state, areas, {}, sigma[0], sigma[1], np.full((2, n), np.nan))
        return buses, make_branch_table(state.network, state.branches, state.flows)

    def meters(self, states: States, readings: ReadingsByArea) -> Table:
        """As ``list_meters``, readings in their ``unit``, and a row for each meter of which no reading is
        known: ``silent`` where its area has said what it used.
        """
        plain = list_meters(states, readings)
        known = [k for k, meter in enumerate(plain.meter) if meter in self._meters]
        listed = [self._meters[plain.meter[k]] for k in known]
        present = set(plain.meter)
        silent = [name for name in self._telemetered if name not in present]
        silent_in = [self._area_of_meter.get(name, "") for name in silent]
        all_meters = [*listed, *(self._meters[name] for name in silent)]
        size, gap = find_unit_sizes(self.scenario.network, listed), np.full(len(silent), np.nan)

        def scaled(name: str) -> np.ndarray:
            return np.concatenate([plain[name][known] * size, gap])

        return Table(
            "meters",
            {
                "meter": [*(plain.meter[k] for k in known), *silent],
                "area": [*(plain.area[k] for k in known), *silent_in],
                "bus": np.array([m.bus for m in all_meters], dtype=np.int64),
                "branch": [m.branch or "" for m in all_meters],
                "unit": [UNIT[m.kind] for m in all_meters],
                "status": [
                    *(plain.status[k] for k in known),
                    *(SILENT if area in readings else UNKNOWN for area in silent_in),
                ],
                **{name: scaled(name) for name in ("reading", "sigma", "estimate")},
                **{name: np.concatenate([plain[name][known], gap]) for name in RELATIVE},
            },
        )

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
        """The state of ``area`` if it is about its buses: a stranger's may be about others."""
        state = states.get(area)
        own = self.partition.area(area).network.row
        return state if state is not None and state.buses and own.keys() == set(state.buses) else None

    def _voltages_of(self, area: str, state: StateMessage) -> AreaVoltages:
        place = {bus: k for k, bus in enumerate(state.buses)}
        order = [place[bus.id] for bus in self.partition.area(area).network.buses]
        return AreaVoltages(np.array(state.vm)[order], np.array(state.va)[order], state.referenced)
