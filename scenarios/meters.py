"""Meters of a scenario, and the standard deviation of each."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dsse_core.grid.columns import Records
from dsse_core.grid.measurement import LONGEST_BUS, MeasurementKind, Meter, MeterPlace, Source
from dsse_core.grid.meter_table import KINDS, NO_BRANCH, SOURCES, find_virtual, make_meters, number_kinds
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import list_phases
from dsse_core.limits import LARGEST_SIGMA, SMALLEST_SIGMA
from scenarios.files.scenario_file import AngleMeterTable, MeasurementsTable, SigmaTable
from scenarios.injections import Injections
from scenarios.meter_places import TOTAL, Place, Sites, Spots, join_spots, make_totals

KIND = MeasurementKind
INJECTIONS = (KIND.P_INJECTION, KIND.Q_INJECTION)
SUM_OF_CURRENTS = (KIND.I_REAL, KIND.I_IMAG)
TABLES_AT_BUSES, TABLES_ON_BRANCHES = (
    {kind.table: KIND.of_table(kind.table) for kind in KIND if kind.place is place}
    for place in (MeterPlace.BUS, MeterPlace.BRANCH)
)
LARGEST = 10**LONGEST_BUS


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
                least = 0.0 if kind.of_voltage else self.floor
                sigma[of_kind] = np.maximum(self.relative[kind] * size[of_kind], least)
        sigma[virtual] = 0.0
        return sigma


def build_sigma_rule(table: MeasurementsTable, network: Network) -> SigmaRule:
    """The sigmas of a scenario file, in p.u. and rad."""
    relative, absolute = dict[MeasurementKind, float](), dict[MeasurementKind, float]()
    for kind in KIND:
        match getattr(table, kind.table) if kind.table else None:
            case AngleMeterTable(sigma_deg=sigma_deg):
                absolute[kind] = math.radians(sigma_deg)
            case SigmaTable(sigma_percent=None, sigma_pu=float(sigma)):
                absolute[kind] = sigma
            case SigmaTable(sigma_percent=float(percent)):
                relative[kind] = percent / 100
    return SigmaRule(relative, absolute, _floor_of(table, network))


def _floor_of(table: MeasurementsTable, network: Network) -> float:
    """``floor_kva`` in p.u. of a node."""
    return table.floor_kva / 1000 / network.node_mva


def find_floor_problems(table: MeasurementsTable, network: Network) -> Iterable[str]:
    """A problem where ``floor_kva`` is no standard deviation that an estimator can compute with."""
    floor = _floor_of(table, network)
    if not SMALLEST_SIGMA <= floor <= LARGEST_SIGMA:
        yield (
            f"measurements.floor_kva: {table.floor_kva:g} kVA is {floor:g} p.u. on {_name_base(network)}; "
            f"it must lie between {SMALLEST_SIGMA:g} and {LARGEST_SIGMA:g} p.u.; correct it"
        )


def _name_base(network: Network) -> str:
    share = "" if network.table.nodes.is_balanced else "a third of "
    return f"{share}base_mva {network.base_mva:g}"


def build_meters(table: MeasurementsTable, network: Network) -> Records[Meter]:
    """The meters of a scenario file on ``network``; unknown places are left out (``find_place_problems`` reports them).

    A bus without load and source injects nothing: under ``zero_injection = "virtual"`` it has an exact constraint in
    place of an ordinary injection meter. With phases this holds for each node by itself, and the currents of a bus with
    loads between phases alone sum to zero; where its loads can be told apart they are metered one by one.
    """
    return _Places(table, network).build()


def find_tap_problems(network: Network, meters: Sequence[Meter]) -> Iterator[str]:
    """Ends of branches with estimated taps that have no voltmeter: where one lies further away, the drop of voltage in
    between counts as tap.
    """
    if not network.estimated_taps:
        return
    metered = {meter.bus for meter in meters if meter.kind is MeasurementKind.VM}
    for name in network.estimated_taps:
        branch = network.branch(name)
        if without := [str(bus) for bus in (branch.from_bus, branch.to_bus) if bus not in metered]:
            yield (
                f"network: branch {name} has estimate_tap, which needs a voltmeter at both ends; add a meter of "
                f"voltage at bus {', '.join(without)}, or leave estimate_tap out"
            )


def find_place_problems(table: MeasurementsTable, network: Network) -> Iterable[str]:
    """Every bus and branch of ``table`` that is unknown, out of service or listed twice, with its key; and every phase
    that is not there.
    """
    return _Places(table, network).find_problems()


@dataclass(frozen=True)
class _Places:
    """Places of the meters of ``table`` in ``network``."""

    table: MeasurementsTable
    network: Network

    @cached_property
    def buses(self) -> Sites:
        return Sites("bus", self.network.row, self.network.table.nodes)

    @cached_property
    def branches(self) -> Sites:
        row_of = {branch: k for k, branch in enumerate(self.network.active_branch_ids)}
        return Sites("branch", row_of, self.network.table.ports)

    @cached_property
    def injections(self) -> Injections:
        return Injections(self.network)

    @cached_property
    def virtual(self) -> np.ndarray:
        is_idle, listed = self.injections.is_idle, self.table.zero_injection
        if listed == "virtual":
            return np.flatnonzero(is_idle)
        spots = self.buses.find(() if listed == "measured" else listed)
        nodes = self.network.table.nodes.find(spots.row, spots.phases[0])
        virtual: np.ndarray = nodes[(nodes >= 0) & is_idle[nodes]]
        return virtual

    @cached_property
    def virtual_sums(self) -> np.ndarray:
        """True for each bus whose currents sum to zero, for every estimator, (n_bus,)."""
        sums_to_zero, listed = self.injections.sums_to_zero, self.table.zero_injection
        if listed == "virtual":
            return sums_to_zero
        is_listed = np.zeros(len(sums_to_zero), dtype=bool)
        is_listed[self.buses.list_whole(() if listed == "measured" else listed)] = True
        return sums_to_zero & is_listed

    def build(self) -> Records[Meter]:
        groups = [_Group(kinds, self._at(key)) for key, kinds in TABLES_AT_BUSES.items()]
        groups += [_Group(kinds, self._on(key), of_branch=True) for key, kinds in TABLES_ON_BRANCHES.items()]
        groups += [_Group(INJECTIONS, self._find_injections())]
        groups += [_Group(INJECTIONS, self.buses.spots_of(self.virtual), source=Source.VIRTUAL)]
        groups += [_Group(SUM_OF_CURRENTS, make_totals(np.flatnonzero(self.virtual_sums)), source=Source.VIRTUAL)]
        columns = zip(*(g.columns(self.network) for g in groups if len(g.spots.row) or g is groups[0]), strict=True)
        kind, bus, branch, source, phases = (np.concatenate(column, axis=-1) for column in columns)
        return make_meters(self.network, kind, bus, branch, source, phases)

    def _listed(self, key: str) -> Sequence[Place] | None:
        """The places of a key; none where it is not given."""
        part = getattr(self.table, key)
        listed: Sequence[Place] | None = getattr(part, self._sites_of(key).key) if part else ()
        return listed

    def _sites_of(self, key: str) -> Sites:
        return self.branches if key in TABLES_ON_BRANCHES else self.buses

    def _at(self, key: str) -> Spots:
        """The spots of a key with buses, between phases at whole buses in parts without ground."""
        listed, table = self._listed(key), self.network.table
        if not (ungrounded := self.network.gauge.ungrounded):
            return self.buses.find(listed)
        whole = self.buses.list_whole(listed)
        floats = np.isin(table.bus_id[whole], ungrounded)
        to_ground = self.buses.spots_of(table.nodes.of(whole[~floats]))
        return join_spots([to_ground, self.buses.find_pairs(whole[floats]), self.buses.find_named(listed)])

    def _on(self, key: str) -> Spots:
        """The spots of a key with branches, by their rows among all branches."""
        spots = self.branches.find(self._listed(key))
        return Spots(self.network.table.active[spots.row], spots.phases)

    def _find_injections(self) -> Spots:
        """The spots of meters of injection, without those that are virtual."""
        listed, nodes = self._listed("injection"), self.buses.rows
        whole, legs = self.buses.list_whole(listed), self.injections.list_by_leg(self.virtual_sums)
        is_measured = np.bincount(self.virtual, minlength=len(nodes) + 1) == 0  # the last one for no node
        n, at_bus = len(nodes.sets), nodes.item[legs[0]]
        measured = nodes.of(whole[np.bincount(at_bus, minlength=n)[whole] == 0])
        legs = legs[:, np.bincount(whole, minlength=n)[at_bus] > 0]
        pairs, named = Spots(nodes.item[legs[0]], nodes.phase[legs]), self.buses.find_named(listed)
        to_ground = self.buses.spots_of(measured[is_measured[measured]])
        return join_spots([to_ground, pairs, named.keep(is_measured[nodes.find(named.row, named.phases[0])])])

    def find_problems(self) -> Iterator[str]:
        """Problems of all keys, as text."""
        for key in (*TABLES_AT_BUSES, "injection"):
            yield from self._find_problems_of(key)
        yield from self._find_zero_injection_problems()
        for key in TABLES_ON_BRANCHES:
            yield from self._find_problems_of(key)

    def _find_problems_of(self, key: str) -> Iterator[str]:
        sites, listed = self._sites_of(key), self._listed(key) or ()
        path, most = f"measurements.{key}.{sites.key}", 1 if key in TABLES_ON_BRANCHES else 2
        doubtful = [(place, n) for place, n in Counter(listed).items() if n > 1 or place not in sites.row_of]
        for place, count in sorted(doubtful, key=_order):
            problem = self._find_missing(sites, place)
            problem = problem or sites.find_problem_of_phases(
                place, most, has_total=all(kind.has_total for kind in KIND.of_table(key))
            )
            if key == "injection" and not problem:
                problem = self._find_leg_problem(place)
            if problem:
                yield f"{path}: {problem}"
            if count > 1:
                yield f"{path}: {sites.word} {_quote(sites, place)} is listed twice; keep one"
        yield from (f"{path}: {problem}" for problem in _find_overlaps(sites, listed))

    def _find_missing(self, sites: Sites, place: Place) -> str:
        """A problem where a bus or branch is unknown, or out of service; else empty."""
        site, _ = sites.read(place)
        if site in sites.row_of:
            return ""
        unknown = f"{sites.word} {_quote(sites, site)} is not in network {self.network.name!r}"
        if sites.word == "bus":
            return unknown
        if site in self.network.branch_ids:
            return f"branch {site!r} is out of service; remove it from the list"
        return f"{unknown}; a branch is called FROM-TO unless the network file gives it an id"

    def _find_leg_problem(self, place: Place) -> str:
        """A problem where ``place`` is between two phases and no meter reads the power there; else empty."""
        spot = self.buses.find_named([place])
        if not (spot.phases[1] >= 0).any():
            return ""
        bus, phases = self.buses.read(place)
        problem, cure = self.injections.find_problem_of_leg(int(bus), phases)
        return f"{place!r}: {problem}; {cure}" if problem else ""

    def _find_zero_injection_problems(self) -> Iterator[str]:
        given, path = self.table.zero_injection, "measurements.zero_injection"
        listed = given if isinstance(given, tuple) else ()
        for place, count in sorted(Counter(listed).items(), key=_order):
            name = _quote(self.buses, place)
            problem = self._find_missing(self.buses, place)
            if problem := problem or self.buses.find_problem_of_phases(place, 1, has_total=False):
                yield f"{path}: {problem}"
            elif not self._injects_nothing(place):
                yield f"{path}: bus {name} has a load or a source in the network file; remove it here"
            if count > 1:
                yield f"{path}: bus {name} is listed twice; keep one"
        yield from (f"{path}: {problem}" for problem in _find_overlaps(self.buses, listed))

    def _injects_nothing(self, place: Place) -> bool:
        """True where a node of ``place`` has no load and no source, or the currents of the bus sum to zero."""
        spots = self.buses.find([place])
        is_idle = self.injections.is_idle[self.network.table.nodes.find(spots.row, spots.phases[0])]
        return bool(is_idle.any() or self.virtual_sums[self.buses.list_whole([place])].any())


def _order(counted: tuple[Place, int]) -> tuple[int, str]:
    """Numbers in their order, before texts."""
    place = counted[0]
    return (place, "") if isinstance(place, int) else (LARGEST, place)


def _quote(sites: Sites, place: Place) -> str:
    return str(place) if sites.word == "bus" else repr(place)


def _find_overlaps(sites: Sites, listed: Sequence[Place]) -> Iterator[str]:
    """Places with phases beside the whole of their bus or branch, and two phases beside the same in the other order."""
    given: set[Place] = {place for place in listed if place in sites.row_of}
    for place in dict.fromkeys(listed):
        if place in sites.row_of:
            continue
        site, text = sites.read(place)
        phases = [] if text == TOTAL else list_phases(text)
        again = f"{site}.{''.join(reversed(phases))}" if len(phases) > 1 else site if phases else None
        if again != place and again in given:
            yield f"{sites.word} {_quote(sites, again)} is listed, and {place!r} as well; keep one"
        given.add(place)


@dataclass(frozen=True)
class _Group:
    """Meters of all ``kinds`` at each of ``spots``, of the network's buses or of its branches."""

    kinds: tuple[MeasurementKind, ...]
    spots: Spots
    of_branch: bool = False
    source: Source = Source.TELEMETERED

    def columns(self, network: Network) -> tuple[np.ndarray, ...]:
        """The columns for ``make_meters``; flows are metered at the from side."""
        count, table = len(self.kinds), network.table
        kind = np.tile([KINDS.index(kind) for kind in self.kinds], len(self.spots.row))
        row = np.repeat(self.spots.row, count)
        bus = (table.from_bus if self.of_branch else table.bus_id)[row]
        branch = row if self.of_branch else np.full(len(row), NO_BRANCH)
        source = np.full(len(row), SOURCES.index(self.source))
        return kind, bus, branch, source, np.repeat(self.spots.phases, count, axis=1)
