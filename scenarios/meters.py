"""Meters of a scenario, and the standard deviation of each."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from dsse_core.grid.columns import Records
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.grid.meter_table import KINDS, NO_BRANCH, SOURCES, find_virtual, make_meters, number_kinds
from dsse_core.grid.network import Network
from dsse_core.limits import LARGEST_SIGMA, SMALLEST_SIGMA
from scenarios.files.scenario_file import (
    AngleMeterTable,
    BranchMeterTable,
    BusMeterTable,
    MeasurementsTable,
    SigmaTable,
)

KIND = MeasurementKind
INJECTIONS = (KIND.P_INJECTION, KIND.Q_INJECTION)
Place = TypeVar("Place", int, str)


@dataclass(frozen=True)
class SigmaRule:
    """Standard deviation by kind of meter: ``relative`` to the true value, or ``absolute`` in p.u. (rad for angles).

    The relative sigma of an active or reactive power refers to the apparent power at that place. Relative sigmas
    of powers and currents are at least ``floor`` (p.u.; for currents, of that power at 1 p.u. voltage).
    """

    relative: dict[MeasurementKind, float]
    absolute: dict[MeasurementKind, float]
    floor: float

    def sigmas(self, meters: Sequence[Meter], size: np.ndarray) -> np.ndarray:
        """Standard deviations of ``meters``, p.u. or rad, shape (n_meas,); 0 of virtual ones.

        ``size``: of each the size of the true value, of a power that of the apparent power at its place.

        Raises:
            KeyError: there is no rule for a kind of meter.
        """
        kinds, virtual = number_kinds(meters), find_virtual(meters)
        ruled = self.relative.keys() | self.absolute.keys()
        if unruled := {kind for k, kind in enumerate(KINDS) if (kinds[~virtual] == k).any()} - ruled:
            raise KeyError(min(unruled))
        sigma = np.zeros(len(meters))
        for kind in ruled:
            of_kind = kinds == KINDS.index(kind)
            if kind in self.absolute:
                sigma[of_kind] = self.absolute[kind]
            else:
                least = 0.0 if kind is KIND.VM else self.floor
                sigma[of_kind] = np.maximum(self.relative[kind] * size[of_kind], least)
        sigma[virtual] = 0.0
        return sigma


def build_sigma_rule(table: MeasurementsTable, base_mva: float) -> SigmaRule:
    """The sigmas of a scenario file, in p.u. and rad."""
    by_kind: dict[MeasurementKind, SigmaTable | None] = {
        KIND.VM: table.voltage,
        KIND.P_FLOW: table.flow,
        KIND.Q_FLOW: table.flow,
        KIND.P_INJECTION: table.injection,
        KIND.Q_INJECTION: table.injection,
        KIND.CURRENT: table.current,
    }
    relative = {k: t.sigma_percent / 100 for k, t in by_kind.items() if t and t.sigma_percent is not None}
    absolute = {k: t.sigma_pu for k, t in by_kind.items() if t and t.sigma_pu is not None}
    if table.angle:
        absolute[KIND.VA] = math.radians(table.angle.sigma_deg)
    return SigmaRule(relative, absolute, table.floor_kva / 1000 / base_mva)


def find_floor_problems(table: MeasurementsTable, network: Network) -> Iterable[str]:
    """A problem where ``floor_kva`` is no standard deviation that an estimator can compute with."""
    floor = table.floor_kva / 1000 / network.base_mva
    if not SMALLEST_SIGMA <= floor <= LARGEST_SIGMA:
        yield (
            f"measurements.floor_kva: {table.floor_kva:g} kVA is {floor:g} p.u. on base_mva {network.base_mva:g}; "
            f"it must lie between {SMALLEST_SIGMA:g} and {LARGEST_SIGMA:g} p.u.; correct it"
        )


def build_meters(table: MeasurementsTable, network: Network) -> Records[Meter]:
    """The meters of a scenario file on ``network``; unknown places are left out (``find_place_problems`` reports them).

    A bus without load and source injects nothing: under ``zero_injection = "virtual"`` it has an exact constraint in
    place of an ordinary injection meter.
    """
    virtual = _rows_of(tuple(find_virtual_buses(table, network)), network.table.bus_id)
    on_branches = (((KIND.P_FLOW, KIND.Q_FLOW), table.flow), ((KIND.CURRENT,), table.current))
    groups = [_Group((kind,), _at(key, network)) for kind, key in ((KIND.VM, table.voltage), (KIND.VA, table.angle))]
    groups += [_Group(kinds, _on(key, network), of_branch=True) for kinds, key in on_branches]
    measured = _at(table.injection, network)
    groups += [_Group(INJECTIONS, measured[~np.isin(measured, virtual)])]
    groups += [_Group(INJECTIONS, virtual, source=Source.VIRTUAL)]
    columns = zip(*(group.columns(network) for group in groups), strict=True)
    return make_meters(network, *map(np.concatenate, columns))


@dataclass(frozen=True)
class _Group:
    """Meters of all ``kinds`` at each of ``rows``, (n,), of the network's buses or of its branches."""

    kinds: tuple[MeasurementKind, ...]
    rows: np.ndarray
    of_branch: bool = False
    source: Source = Source.TELEMETERED

    def columns(self, network: Network) -> tuple[np.ndarray, ...]:
        """The columns for ``make_meters``; flows are metered at the from side."""
        count, table = len(self.kinds), network.table
        kind = np.tile([KINDS.index(kind) for kind in self.kinds], len(self.rows))
        row = np.repeat(self.rows, count)
        bus = (table.from_bus if self.of_branch else table.bus_id)[row]
        branch = row if self.of_branch else np.full(len(row), NO_BRANCH)
        return kind, bus, branch, np.full(len(row), SOURCES.index(self.source))


def _at(key: BusMeterTable | AngleMeterTable | None, network: Network) -> np.ndarray:
    """The rows of the buses of a key."""
    return _rows_of(key.buses if key else (), network.table.bus_id)


def _on(key: BranchMeterTable | None, network: Network) -> np.ndarray:
    """The rows of the branches of a key among all, those in service."""
    rows: np.ndarray = network.table.active[_rows_of(key.branches if key else (), network.active_branch_ids)]
    return rows


def _rows_of(listed: Sequence[Place] | None, places: np.ndarray | Sequence[Place]) -> np.ndarray:
    """Positions in ``places`` of the listed places that exist, each once; all positions where ``listed`` is None."""
    if listed is None:
        return np.arange(len(places))
    known = places.tolist() if isinstance(places, np.ndarray) else places
    row = {place: k for k, place in enumerate(known)} if listed else {}
    return np.array([row[place] for place in dict.fromkeys(listed) if place in row], dtype=np.intp)


def find_place_problems(table: MeasurementsTable, network: Network) -> Iterable[str]:
    """Every bus and branch of ``table`` that is unknown, out of service or listed twice, with its key."""
    for key in ("voltage", "angle", "injection"):
        buses: tuple[int, ...] | None = (part := getattr(table, key)) and part.buses
        for bus, count in sorted(Counter(buses or ()).items()):
            if bus not in network.row:
                yield f"measurements.{key}.buses: bus {bus} is not in network {network.name!r}"
            if count > 1:
                yield f"measurements.{key}.buses: bus {bus} is listed twice; keep one"
    yield from _find_zero_injection_problems(table, network)
    in_service = dict(zip(network.branch_ids, network.table.in_service.tolist(), strict=True))
    for key in ("flow", "current"):
        branches: tuple[str, ...] | None = (part := getattr(table, key)) and part.branches
        for branch, count in sorted(Counter(branches or ()).items()):
            if branch not in in_service:
                yield (
                    f"measurements.{key}.branches: branch {branch!r} is not in network {network.name!r}; "
                    "a branch is called FROM-TO unless the network file gives it an id"
                )
            elif not in_service[branch]:
                yield f"measurements.{key}.branches: branch {branch!r} is out of service; remove it from the list"
            if count > 1:
                yield f"measurements.{key}.branches: branch {branch!r} is listed twice; keep one"


def _find_zero_injection_problems(table: MeasurementsTable, network: Network) -> Iterable[str]:
    listed = table.zero_injection if isinstance(table.zero_injection, tuple) else ()
    empty = _find_zero_injections(network)
    for bus, count in sorted(Counter(listed).items()):
        if bus not in network.row:
            yield f"measurements.zero_injection: bus {bus} is not in network {network.name!r}"
        elif bus not in empty:
            yield f"measurements.zero_injection: bus {bus} has a load or a source in the network file; remove it here"
        if count > 1:
            yield f"measurements.zero_injection: bus {bus} is listed twice; keep one"


def find_virtual_buses(table: MeasurementsTable, network: Network) -> dict[int, None]:
    """The buses that inject exactly nothing, for every estimator."""
    empty = _find_zero_injections(network)
    if table.zero_injection == "virtual":
        return empty
    return {} if table.zero_injection == "measured" else {b: None for b in table.zero_injection if b in empty}


def _find_zero_injections(network: Network) -> dict[int, None]:
    """Buses without load and source; a shunt is part of the network, not an injection."""
    fed = {generator.bus for generator in network.generators}
    unloaded: list[int] = network.table.bus_id[network.table.load == 0].tolist()
    return {bus: None for bus in unloaded if bus not in fed}
