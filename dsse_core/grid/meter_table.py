"""Meters column by column, and meters made of columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from dsse_core.grid.columns import Records, Rows, rows_of_texts
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.network import Network
from dsse_core.grid.network_table import NetworkTable
from dsse_core.grid.nodes import PHASES, PhaseRows, list_phases

KINDS, SOURCES = tuple(MeasurementKind), tuple(Source)
NO_BRANCH, UNKNOWN = -2, -1
TOTAL = PHASES.index("")  # stands for all phases where buses have some
UNKNOWN_BRANCH = "?"  # stands for the id of a branch that the network does not have
QUANTITY = np.array([kind.quantity for kind in KINDS])  # of each kind, as the next
IS_OF_PHASOR = np.array([kind.quantity.is_of_phasor for kind in KINDS])
DEGREE = np.array([kind.quantity.degree for kind in KINDS])
OF_INJECTION = np.array([kind.of_injection for kind in KINDS])
OF_BRANCH = np.array([kind.of_branch for kind in KINDS])
OF_VOLTAGE = np.array([kind.of_voltage for kind in KINDS])
OF_POWER = np.array([kind.of_power for kind in KINDS])
_HAS_TOTAL = np.array([kind.has_total for kind in KINDS])
_IS_VIRTUAL = np.array([kind.is_virtual for kind in KINDS])
LISTED = ("kind", "bus", "branch", "source", "phases")  # attributes of a meter
PHASE_COLUMNS = ("phase", "other_phase")  # of meters in a network with phases, see ``MeterTable.phases``
_CODE_OF_KIND = {id(kind): k for k, kind in enumerate(KINDS)}  # members are singletons, and hashing them takes long


@dataclass(frozen=True)
class MeterTable:
    """Columns of meters, shape (n_meas,) each. ``kind``: position in KINDS. ``bus``: row of the bus, UNKNOWN where the
    network has no such bus. ``branch``: row of the branch among those in service, UNKNOWN where it is not among them,
    NO_BRANCH for a meter at a bus. ``phases`` (2, n_meas): the phase that is metered, TOTAL for all of them, and, where
    a meter stands between two, the other one, else UNKNOWN; None in a balanced network.
    """

    network: NetworkTable
    kind: np.ndarray
    bus: np.ndarray
    branch: np.ndarray
    phases: np.ndarray | None = None

    @cached_property
    def node(self) -> np.ndarray:
        """The row of each meter's node, of a total the first of its bus; UNKNOWN where the network has no such node."""
        if self.phases is None:
            return self.network.nodes.find(self.bus, 0)
        found = self.network.nodes.find(self.bus, self.phases[0])
        return np.where(self.phases[0] == TOTAL, self.network.nodes.first[self.bus], found)

    @cached_property
    def other(self) -> np.ndarray | None:
        """The node to which each meter's voltage counts, UNKNOWN for the ground; None in a balanced network."""
        if self.phases is None:
            return None
        return np.where(self.phases[1] < 0, UNKNOWN, self.network.nodes.find(self.bus, np.maximum(self.phases[1], 0)))

    @property
    def port(self) -> np.ndarray:
        """The port of each meter, UNKNOWN where it is at a bus, a total, or the network has no such port."""
        return self.network.ports.find(self._end, 0 if self.phases is None else self.phases[0])

    @cached_property
    def _end(self) -> np.ndarray:
        """The branch end of each meter, among from ends, then to ends; UNKNOWN where it is at a bus."""
        f = np.append(self.network.f, UNKNOWN)  # the last row stands for NO_BRANCH and UNKNOWN
        branch = np.maximum(self.branch, UNKNOWN)
        at_to = np.where(f[branch] == self.bus, 0, len(f) - 1)
        return np.where(branch < 0, UNKNOWN, branch + at_to)

    def spread(self) -> tuple[MeterTable, np.ndarray | None]:
        """The meters with a row for each phase of a total, and the meter of each row, (n_row,); None without totals."""
        if self.phases is None or not (is_total := self.phases[0] == TOTAL).any():
            return self, None
        of_bus, of_end = self.network.nodes.sets[self.bus], np.append(self.network.ports.sets, 0)[self._end]
        there = np.where(self.branch < 0, of_bus, of_end)
        rows = PhaseRows(np.where(is_total, there, 1 << self.phases[0]))
        meter, phases = rows.item, np.array([rows.phase, self.phases[1][rows.item]])
        return MeterTable(self.network, self.kind[meter], self.bus[meter], self.branch[meter], phases), meter

    @property
    def n_phases(self) -> np.ndarray:
        """The number of phases that each meter adds up, (n_meas,): 1, of a total those of its bus or branch end."""
        _, of_meter = self.spread()
        return np.ones(len(self.kind), dtype=np.intp) if of_meter is None else np.bincount(of_meter)


def average(values: np.ndarray, of_meter: np.ndarray | None) -> np.ndarray:
    """The mean of the rows of each meter, (n_meas, ...), from ``values`` (n_row, ...); see ``MeterTable.spread``."""
    if of_meter is None:
        return values
    first = find_first(of_meter)
    count = np.diff(first, append=len(of_meter)).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(np.add.reduceat(values, first) / count)


def find_first(of_meter: np.ndarray) -> np.ndarray:
    """The first row of each meter, (n_meas,), from the meter of each row, (n_row,)."""
    return np.flatnonzero(np.diff(of_meter, prepend=-1))


def make_meters(
    network: Network,
    kind: np.ndarray,
    bus: np.ndarray,
    branch: np.ndarray,
    source: np.ndarray | None = None,
    phases: np.ndarray | None = None,
) -> Records[Meter]:
    """Meters of ``network`` from columns (n_meas,); a plan reads the columns without visiting each meter.

    Args:
        kind: positions in KINDS.
        bus: ids of buses.
        branch: rows of ``network.branches``, NO_BRANCH for a meter at a bus, UNKNOWN for a branch that is not there.
        source: positions in SOURCES; all telemetered by default.
        phases: (2, n_meas), as in MeterTable; none are named by default. A balanced network has none.
    """
    if source is None:
        source = np.zeros(len(kind), dtype=np.int64)
    columns = {"kind": kind, "bus": bus, "branch": branch, "source": source}
    if not network.table.nodes.is_balanced:
        none = np.zeros(len(kind), dtype=np.int64), np.full(len(kind), UNKNOWN)
        columns |= dict(zip(PHASE_COLUMNS, none if phases is None else phases, strict=True))
    return Records(_MakeMeter(network.branch_ids), columns)


def join_meters(network: Network, parts: Sequence[Sequence[Meter]]) -> Sequence[Meter]:
    """The meters of all ``parts``, of ``network``, one after the other; columns where all parts are columns."""
    columns = [part.columns for part in parts if isinstance(part, Records)]
    if len(columns) < len(parts):
        return tuple(meter for part in parts for meter in part)
    joined = {key: np.concatenate([part[key] for part in columns]) for key in columns[0]}
    return Records(_MakeMeter(network.branch_ids), joined)


def each_fits(network: Network, meters: Records[Meter]) -> bool:
    """True where ``find_meter_problems`` would find no problem of any single meter; duplicates are not looked for.

    ``meters`` are those of ``make_meters``.
    """
    table = network.table
    kind, bus, branch = (meters.columns[key] for key in ("kind", "bus", "branch"))
    if (table.rows.find(bus) < 0).any() or ((branch >= 0) != OF_BRANCH[kind]).any() or (branch == UNKNOWN).any():
        return False
    if not can_be_virtual(meters):
        return False
    metered, at = branch[branch >= 0], bus[branch >= 0]
    ends = (at == table.from_bus[metered]) | (at == table.to_bus[metered])
    return bool(ends.all() and table.in_service[metered].all()) and _have_nodes(network, meters)


def _have_nodes(network: Network, meters: Records[Meter]) -> bool:
    """True where each of ``meters``, at known buses and branches, names one phase that is there, or two of a bus, or is
    a total.
    """
    must_be_virtual = _IS_VIRTUAL[number_kinds(meters)]
    if network.table.nodes.is_balanced:
        return not must_be_virtual.any()
    table = tabulate_meters(network, meters)
    assert table.phases is not None  # as ``network`` has phases
    assert table.other is not None
    is_alone, at_bus = table.phases[1] == UNKNOWN, table.branch < 0
    is_pair = at_bus & (table.other >= 0) & (table.other != table.node)
    is_there, is_total = np.where(at_bus, table.node, table.port) >= 0, table.phases[0] == TOTAL
    fits = np.where(is_total, _HAS_TOTAL[table.kind], is_there) & (is_alone | is_pair)
    if ungrounded := network.gauge.ungrounded:
        fits &= ~(is_alone & OF_VOLTAGE[table.kind] & np.isin(meters.columns["bus"], ungrounded))
    return bool((fits & (~must_be_virtual | is_total & find_virtual(meters))).all())


@dataclass(frozen=True)
class _MakeMeter:
    """Maker of a meter from its row of the columns."""

    branch_ids: Sequence[str]

    def __call__(
        self, kind: int, bus: int, branch: int, source: int, phase: int = 0, other_phase: int = UNKNOWN
    ) -> Meter:
        phases = write_pair(phase, other_phase) if phase else ""
        return Meter(KINDS[kind], bus, self.id_of(branch), SOURCES[source], phases)

    def id_of(self, branch: int) -> str | None:
        """Id of the branch in a row of the network; None at a bus."""
        if branch < 0:
            return None if branch == NO_BRANCH else UNKNOWN_BRANCH
        return self.branch_ids[branch]


def list_ids(meters: Sequence[Meter]) -> list[str]:
    """The id of each of ``meters``."""
    if not isinstance(meters, Records):
        return [meter.id for meter in meters]
    columns = meters.columns
    kinds, buses = [f"{kind}@" for kind in KINDS], columns["bus"].tolist()
    if "phase" in columns:
        buses = [
            f"{bus}.{of_bus}" if of_bus else bus for bus, of_bus in zip(buses, list_named_phases(meters), strict=True)
        ]
    rows = zip(columns["kind"].tolist(), buses, _list_branches(meters), strict=True)
    return [f"{kinds[kind]}{bus}:{branch}" if branch else f"{kinds[kind]}{bus}" for kind, bus, branch in rows]


def list_columns(meters: Sequence[Meter]) -> dict[str, list[Any]]:
    """Attribute of ``Meter`` -> its values for ``meters``, kinds and sources as plain text."""
    if not isinstance(meters, Records):
        columns = {name: [getattr(meter, name) for meter in meters] for name in LISTED}
        return columns | {name: [str(value) for value in columns[name]] for name in ("kind", "source")}
    return {
        "kind": list_texts([str(kind) for kind in KINDS], meters.columns["kind"]),
        "bus": meters.columns["bus"].tolist(),
        "branch": _list_branches(meters),
        "source": list_texts([str(source) for source in SOURCES], meters.columns["source"]),
        "phases": list_named_phases(meters),
    }


def list_named_phases(meters: Records[Meter]) -> list[str]:
    """The attribute ``phases`` of each of ``meters``."""
    if "phase" not in meters.columns:
        return [""] * len(meters)
    return list(map(write_pair, *(meters.columns[key].tolist() for key in PHASE_COLUMNS)))


def write_pair(phase: int, other: int) -> str:
    """The phases of a meter as text, such as "a" and "ab", from their places in PHASES; ``other``: UNKNOWN without."""
    return PHASES[phase] if other == UNKNOWN else PHASES[phase] + PHASES[other]


def _list_branches(meters: Records[Meter]) -> list[str | None]:
    make = meters.make
    assert isinstance(make, _MakeMeter)
    return list(map(make.id_of, meters.columns["branch"].tolist()))


def list_texts(texts: Sequence[str], numbers: np.ndarray) -> list[str]:
    """The items of ``texts`` at the positions ``numbers``, (k,)."""
    taken: list[str] = np.array(texts, dtype=object)[numbers].tolist()
    return taken


def find_places(network: Network, meters: Sequence[Meter], wanted: Sequence[Meter]) -> np.ndarray:
    """The position in ``meters`` of each of ``wanted``, (k,), -1 where it is not there; all fit the network."""
    if meters is wanted:
        return np.arange(len(wanted))
    return Rows(number_meters(network, meters)).find(number_meters(network, wanted))


def number_meters(network: Network, meters: Sequence[Meter]) -> np.ndarray:
    """A number for each of ``meters``, (n_meas,), the same for the same kind and place; each meter fits the network."""
    table, n = tabulate_meters(network, meters), network.n_nodes
    other = 0 if table.phases is None or table.other is None else np.where(table.phases[0] == TOTAL, 0, table.other + 2)
    place = (other * (len(network.table.active) + 2) + table.branch - NO_BRANCH) * n + table.node
    number: np.ndarray = place * len(KINDS) + table.kind
    return number


def tabulate_meters(network: Network, meters: Sequence[Meter]) -> MeterTable:
    """The columns of ``meters`` in ``network``."""
    table = network.table
    if isinstance(meters, Records):
        columns = meters.columns
        branch = columns["branch"]
        if not table.in_service.all():
            branch = np.append(table.active_row, (NO_BRANCH, UNKNOWN))[branch]  # the last rows stand for -2 and -1
        named = np.stack([columns[key] for key in PHASE_COLUMNS]) if "phase" in columns else None
        return MeterTable(table, columns["kind"], table.rows.find(columns["bus"]), branch, named)
    bus = np.array([meter.bus for meter in meters], dtype=np.int64)
    branch = rows_of_texts(network.active_branch_ids, [meter.branch for meter in meters])
    phases = None if table.nodes.is_balanced else _number_phases(meters)
    return MeterTable(table, number_kinds(meters), table.rows.find(bus), branch, phases)


def _number_phases(meters: Sequence[Meter]) -> np.ndarray:
    """The places in PHASES of the one or two phases of each meter, (2, n_meas), UNKNOWN without."""
    numbers = [read_pair(meter.phases) or (UNKNOWN, UNKNOWN) for meter in meters]
    return np.array(numbers, dtype=np.int64).reshape(-1, 2).T


def read_pair(text: str) -> tuple[int, int] | None:
    """The places in PHASES of one phase or two, UNKNOWN without the other one; None where ``text`` is neither."""
    numbers = [PHASES.index(phase) for phase in list_phases(text)]
    if len(numbers) not in (1, 2):
        return None
    return numbers[0], numbers[1] if len(numbers) > 1 else UNKNOWN


def read_meters_of(readings: Sequence[Measurement]) -> Sequence[Meter]:
    """The meter of each of ``readings``: columns where ``readings`` are columns, else a tuple."""
    if isinstance(readings, Records):
        meters: Sequence[Meter] = readings.columns["meter"]
        return meters
    return tuple(reading.meter for reading in readings)


def number_kinds(meters: Sequence[Meter]) -> np.ndarray:
    """The position of each meter's kind in KINDS, shape (n_meas,)."""
    if isinstance(meters, Records):
        kinds: np.ndarray = meters.columns["kind"]
        return kinds
    return np.array([_CODE_OF_KIND[id(meter.kind)] for meter in meters], dtype=np.int64)


def find_virtual(meters: Sequence[Meter]) -> np.ndarray:
    """True for each of ``meters`` that is virtual, shape (n_meas,)."""
    if isinstance(meters, Records):
        virtual: np.ndarray = meters.columns["source"] == SOURCES.index(Source.VIRTUAL)
        return virtual
    return np.array([meter.source is Source.VIRTUAL for meter in meters], dtype=bool)


def can_be_virtual(meters: Sequence[Meter]) -> bool:
    """True where all of ``meters`` that are virtual are of injections."""
    virtual = find_virtual(meters)
    return not virtual.any() or bool(OF_INJECTION[number_kinds(meters)[virtual]].all())
