"""Tables of results as the messages of areas that would show them, so that they are played as a recording is."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from agents.messages.keys import live_key
from agents.messages.packing import Header, Incarnation, ReadingsMessage, StateMessage
from agents.protocol.quality import DEGRADED, GOOD, NONE
from coordinator.watch.replay.recorded_messages import Presence, Timed, find_begin
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import LARGEST_JSON, read_text
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.grid.measurement import Meter, Source
from dsse_core.grid.nodes import name_node
from dsse_core.grid.partition import Area
from dsse_core.results.meters import CRITICAL, REMOVED, UNITS, find_unit_sizes
from dsse_core.results.table import ALL_PHASES
from scenarios.files.readings.file import read_time
from scenarios.scenario import Scenario

RUN = "results"  # name of the played run, as no bus has it
SENDER = Incarnation(1, 1)
BUSES = "buses.csv"
OF_BUSES = ("vm_pu", "va_deg", "sigma_vm_pu", "sigma_va_deg")
OF_METERS = ("value", "sigma", "estimate")  # columns with the unit in their names
BAD_DATA_LEFT = "bad data are left: J exceeds its limit, and no meter stands out"

Voltages = tuple[float, float, float, float]
"""OF_BUSES of a node; nan where not known."""


@dataclass
class _Scan:
    """Rows of one scan: ``nodes`` by bus and phase, "" in a balanced network, ``meters`` by id with OF_METERS in their
    units and the normalised residual.
    """

    time: float
    nodes: dict[tuple[int, str], Voltages] = field(default_factory=dict)
    meters: dict[str, tuple[float, ...]] = field(default_factory=dict)
    status: dict[str, str] = field(default_factory=dict)
    quality: dict[str, str] = field(default_factory=dict)
    age_s: dict[str, float] = field(default_factory=dict)
    notes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    reason: str = ""
    objective: float = 0.0
    degrees_of_freedom: int = 0


def holds_results(folder: Path) -> bool:
    """True where ``folder`` has tables of results."""
    return (folder / BUSES).is_file()


def read_result_messages(folder: Path, scenario: Scenario, notes: list[str]) -> list[Timed]:
    """States, readings and presence of the areas of ``scenario`` as the tables in ``folder`` have them; the newest part
    of many scans. Without the times of all scans they are one second apart. Omitted parts go to ``notes``.

    Raises:
        InvalidInputError: a table cannot be read, or is none of a network with these buses.
    """
    scans = _read_scans(folder)
    known = set(scenario.network.nodes)
    if strange := {node for scan in scans.values() for node in scan.nodes} ^ known:
        name = name_node(*min(strange))
        problem = f"its buses are not those of {scenario.name!r}: {name}; give the scenario of these results"
        raise InvalidInputError(str(folder / BUSES), [problem])
    maker = _Messages(scenario)
    has_times = not any(math.isnan(scan.time) for scan in scans.values())
    found: list[Timed] = []
    for number, scan in enumerate(scans.values(), 1):
        at = scan.time if has_times else float(number - 1)
        found += [(at, message) for message in maker.messages_of(scan, number, at)]
    found.sort(key=lambda timed: timed[0])
    if begin := find_begin(found):
        found = found[begin:]
        notes.append("there are many scans: their newest part is played")
    names = [area.name for area in scenario.partition.areas]
    return [*((found[0][0], Presence(live_key(RUN, "area", name, SENDER), True)) for name in names), *found]


class _Messages:
    """Makes the messages of scans on the grid of ``scenario``."""

    def __init__(self, scenario: Scenario) -> None:
        self._areas = scenario.partition.areas
        by_area = scenario.partition.meters_by_area(scenario.meters)
        self._meters = {name: [m for m in own if m.source is not Source.VIRTUAL] for name, own in by_area.items()}
        of_all: Sequence[Meter] = [meter for own in self._meters.values() for meter in own]
        sizes = find_unit_sizes(scenario.network, of_all).tolist()
        self._size = {meter.id: size for meter, size in zip(of_all, sizes, strict=True)}

    def messages_of(self, scan: _Scan, number: int, at: float) -> Iterator[StateMessage | ReadingsMessage]:
        for area in self._areas:
            header = Header(RUN, area.name, SENDER, number, number, at)
            yield self._make_readings(header, area, scan)
            yield self._make_state(header, area, scan)

    def _make_readings(self, header: Header, area: Area, scan: _Scan) -> ReadingsMessage:
        own = [meter.id for meter in self._meters[area.name]]
        own = [name for name in own if name in scan.meters and not math.isnan(scan.meters[name][0])]
        rows = [(*(x / self._size[name] for x in scan.meters[name][:3]), scan.meters[name][3]) for name in own]
        described = [row for row in rows if not math.isnan(row[2])]
        order = sorted(range(len(rows)), key=lambda k: math.isnan(rows[k][2]))  # those with an estimate first
        return ReadingsMessage(
            header=header,
            taken_at=header.time,
            meters=tuple(own[k] for k in order),
            values=tuple(rows[k][0] for k in order),
            sigmas=tuple(rows[k][1] for k in order),
            times=(header.time,) * len(rows),
            estimates=tuple(row[2] for row in described),
            normalised=tuple(0.0 if math.isnan(row[3]) else row[3] for row in described),
        )

    def _make_state(self, header: Header, area: Area, scan: _Scan) -> StateMessage:
        network = area.network
        vm, va, sigma_vm, sigma_va = zip(*(scan.nodes[node] for node in network.nodes), strict=True)
        is_known = not any(map(math.isnan, (*vm, *va)))  # flows follow only from angles that all have one reference
        columns = (
            (network.node_buses, vm, _radians(va), _known(sigma_vm), _radians(_known(sigma_va)))
            if is_known
            else ((),) * 5
        )
        own = [meter.id for meter in self._meters[area.name]]
        neighbours = [neighbour.area for neighbour in area.neighbours]
        return StateMessage(
            header,
            *columns,
            referenced=True,
            objective=scan.objective,
            degrees_of_freedom=scan.degrees_of_freedom,
            removed=tuple(name for name in own if scan.status.get(name) == REMOVED),
            critical=tuple(name for name in own if scan.status.get(name) == CRITICAL),
            checked=True,
            sent=dict.fromkeys(neighbours, (0, 0)),
            received=dict.fromkeys(neighbours, (0, 0)),
            messages=0,
            bytes=0,
            lost=0,
            rejected={},
            notes=(scan.reason,) if scan.reason else scan.notes.get(area.name, ()),
            faults={},
            quality=(scan.quality.get(area.name) or GOOD) if is_known else NONE,
            telemetry_age=_known([scan.age_s.get(area.name, 0.0)])[0],
            ages=dict.fromkeys(neighbours, 0.0),
            scans=dict.fromkeys(neighbours, header.scan),
            old_sides=(),
            taken_at=header.time,
            phases=network.node_phases if is_known else (),
        )


def _known(numbers: Sequence[float]) -> tuple[float, ...]:
    return tuple(0.0 if math.isnan(number) else number for number in numbers)


def _radians(angles: Sequence[float]) -> tuple[float, ...]:
    return tuple(map(math.radians, angles))


def _read_scans(folder: Path) -> dict[str, _Scan]:
    """The scans in the tables, by name, in the order of the nodes."""
    scans: dict[str, _Scan] = {}
    for row in _Rows(folder / BUSES, ("bus", "phase", "scan", "time", *OF_BUSES)):
        scan = scans.setdefault(row.text("scan"), _Scan(read_time(row.text("time"))))
        vm, va, sigma_vm, sigma_va = map(row.number, OF_BUSES)
        phase = row.text("phase")
        scan.nodes[int(row.number("bus")), "" if phase == ALL_PHASES else phase] = vm, va, sigma_vm, sigma_va
    if not scans:
        raise InvalidInputError(str(folder / BUSES), ["there is no row; give the folder of other results"])
    in_units = [f"{name}_{unit}" for name in OF_METERS for unit in UNITS]
    for row in _Rows(folder / "meters.csv", ("meter", "scan", "status", "normalised_residual", *in_units)):
        if (of := scans.get(row.text("scan"))) is None:
            continue
        meter = row.text("meter")
        of.status[meter] = row.text("status")
        values = [row.number(*(f"{name}_{unit}" for unit in UNITS)) for name in OF_METERS]
        of.meters[meter] = (*values, row.number("normalised_residual"))
    for row in _Rows(folder / "areas.csv", ("area", "scan", "quality", "value_age_s")):
        if (of := scans.get(row.text("scan"))) is not None:
            of.quality[row.text("area")] = row.text("quality")
            of.age_s[row.text("area")] = row.number("value_age_s")
    if (path := folder / "scans.csv").exists():
        for row in _Rows(path, ("scan", "reason", "objective", "degrees_of_freedom", "bad_data_left")):
            if (of := scans.get(row.text("scan"))) is not None:
                of.reason = row.text("reason")
                if row.text("bad_data_left") == "true":
                    of.notes = {area: (BAD_DATA_LEFT,) for area, quality in of.quality.items() if quality == DEGRADED}
                of.objective, freedom = (row.number(name) for name in ("objective", "degrees_of_freedom"))
                of.objective = 0.0 if math.isnan(of.objective) else of.objective
                of.degrees_of_freedom = 0 if math.isnan(freedom) else int(freedom)
    if len(scans) == 1:
        next(iter(scans.values())).notes = _read_notes(folder / "result.json")
    return scans


class _AreaOfRun(msgspec.Struct):
    notes: tuple[str, ...] = ()


class _ResultOfRun(msgspec.Struct):
    areas: dict[str, _AreaOfRun] = msgspec.field(default_factory=dict)


def _read_notes(path: Path) -> dict[str, tuple[str, ...]]:
    """Notes of each area in the result of a run; none where ``path`` is of another result, or is not there."""
    if not path.is_file():
        return {}
    try:
        content = msgspec.convert(parse_json(read_text(path)), type=_ResultOfRun)
    except ValueError as error:
        raise InvalidInputError(str(path), [f"{error}; give a folder that dsse has written"]) from None
    return {name: area.notes for name, area in content.areas.items()}


class _Rows:
    """Rows of the CSV file at ``path`` that has the columns ``needed`` among others."""

    def __init__(self, path: Path, needed: Sequence[str]) -> None:
        self._path = path
        self._rows = csv.reader(io.StringIO(read_text(path, largest=LARGEST_JSON), newline=""), strict=True)
        header = self._next() or []
        if missing := [name for name in needed if name not in header]:
            problem = f"has no column {', '.join(missing)}; give a folder that this version of dsse has written"
            raise InvalidInputError(str(path), [problem])
        self._length = len(header)
        self._place: Mapping[str, int] = {name: header.index(name) for name in needed}
        self._row: list[str] = []

    def __iter__(self) -> Iterator[_Rows]:
        """This object at each row; raises InvalidInputError with the line where one is damaged."""
        while (row := self._next()) is not None:
            if len(row) != self._length:
                raise self._error(f"{len(row)} columns, but the header has {self._length}")
            self._row = row
            yield self

    def text(self, name: str) -> str:
        """The cell of a column."""
        return self._row[self._place[name]]

    def number(self, *names: str) -> float:
        """The number in the only filled one of these columns; nan where none is."""
        cell = "".join([self._row[self._place[name]] for name in names])
        try:
            return float(cell) if cell else math.nan
        except ValueError:
            raise self._error(f"{', '.join(names)}: {cell!r:.40} is no number") from None

    def _next(self) -> list[str] | None:
        try:
            return next(self._rows, None)
        except csv.Error as error:
            raise self._error(f"not valid CSV ({error})") from None

    def _error(self, problem: str) -> InvalidInputError:
        return InvalidInputError(str(self._path), [f"line {self._rows.line_num}: {problem}"])
