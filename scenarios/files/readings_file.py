"""Readings files: what real meters read, as CSV with a unit in each column name; per unit and radians come out.

The header is ``meter`` and pairs ``value_UNIT,sigma_UNIT``; each row fills the one pair whose unit it is in.
docs/reference/scenario-files.md explains the format.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import read_text
from dsse_core.files.wording import Suggestions, suggest
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, find_meter_problems
from dsse_core.grid.network import Network
from dsse_core.grid.physical_ranges import ANGLE, POWER, REACTIVE_POWER, VOLTAGE, Range
from dsse_core.limits import LARGEST_SIGMA, SMALLEST_SIGMA

KIND = MeasurementKind
UNITS: Mapping[str, frozenset[MeasurementKind]] = {
    "pu": frozenset(kind for kind in KIND if kind is not KIND.VA),
    "kv": frozenset({KIND.VM}),
    "deg": frozenset({KIND.VA}),
    "mw": frozenset({KIND.P_INJECTION, KIND.P_FLOW}),
    "mvar": frozenset({KIND.Q_INJECTION, KIND.Q_FLOW}),
    "a": frozenset({KIND.CURRENT}),
}
"""Unit -> the kinds of meter that may be given in it. Voltages in kV are line to line."""
WRITTEN_IN = {KIND.VM: "pu", KIND.VA: "deg", KIND.CURRENT: "a"} | {
    kind: "mw" if kind in UNITS["mw"] else "mvar" for kind in UNITS["mw"] | UNITS["mvar"]
}
LONGEST_BUS = 18  # digits


def unit_size(unit: str, meter: Meter, network: Network) -> float:
    """What one ``unit`` is in p.u. or rad; ampere and kV on the base voltage of the meter's bus."""
    base_mva = network.base_mva
    match unit:
        case "mw" | "mvar":
            return 1 / base_mva
        case "kv":
            return 1 / network.bus(meter.bus).base_kv
        case "a":
            return math.sqrt(3) * network.bus(meter.bus).base_kv / base_mva / 1000
        case "deg":
            return math.radians(1)
        case _:
            return 1.0


def load_readings(path: Path, network: Network) -> tuple[Measurement, ...]:
    """Read a readings file; values and standard deviations in p.u. and rad, in the file's order.

    Raises:
        InvalidInputError: the file cannot be read, or every problem of its header, or else of its rows, with line
            numbers: unknown meters, meters given twice, wrong units, values that are no numbers.
    """
    text = read_text(path)
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    table = _Table(network)
    try:
        table.take_header(next(rows, []))
        if not table.problems:
            for row in rows:
                table.take(row, rows.line_num)
    except csv.Error as error:
        table.problems.append(f"line {rows.line_num}: not valid CSV ({error})")
    if not table.problems and not table.readings:
        table.problems.append("there is no reading; give one row for each meter")
    if table.problems:
        raise InvalidInputError(str(path), table.problems)
    return tuple(table.readings)


def save_readings(path: Path, network: Network, readings: Sequence[Measurement]) -> None:
    """Write a readings file that ``load_readings`` reads back: p.u. for voltages, else MW, Mvar, degrees, ampere."""
    units = [unit for unit in UNITS if any(WRITTEN_IN[m.meter.kind] == unit for m in readings)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["meter", *(f"{column}_{unit}" for unit in units for column in ("value", "sigma"))])
        for m in readings:
            unit = WRITTEN_IN[m.meter.kind]
            size = unit_size(unit, m.meter, network)
            pair = [repr(float(m.value / size)), repr(float(m.sigma / size))]  # exact
            writer.writerow([m.meter.id, *(cell for u in units for cell in (pair if u == unit else ["", ""]))])


@dataclass
class _Table:
    """The rows read so far, and what is wrong with them."""

    network: Network
    units: list[str] = field(default_factory=list)
    readings: list[Measurement] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    line_of: dict[str, int] = field(default_factory=dict)
    meant: Suggestions = field(default_factory=lambda: Suggestions(list(KIND)))

    def take_header(self, header: Sequence[str]) -> None:
        allowed = ["meter", *(f"{column}_{unit}" for unit in UNITS for column in ("value", "sigma"))]
        if len(header) == 1 and ";" in header[0]:
            self.problems.append("line 1: the columns are separated by ';'; separate them by ','")
            return
        if not header or header[0] != "meter":
            found = f"{header[0]!r:.80}" if header else "an empty file"
            self.problems.append(f"line 1: the first column must be 'meter', found {found}")
        for name in header:
            if name not in allowed:
                self.problems.append(
                    f"line 1: unknown column {name!r:.80}; allowed: {', '.join(allowed)}{suggest(name, allowed)}"
                )
        self.units = [name.removeprefix("value_") for name in header if name.startswith("value_")]
        expected = ["meter", *(f"{column}_{unit}" for unit in self.units for column in ("value", "sigma"))]
        if not self.problems and (list(header) != expected or len(set(header)) < len(header) or not self.units):
            self.problems.append(
                "line 1: after 'meter' come pairs value_UNIT,sigma_UNIT of one unit, each unit once; found "
                + ",".join(header)[:200]
            )

    def take(self, row: Sequence[str], line: int) -> None:
        if not any(cell.strip() for cell in row):
            return
        found = list(self._find_problems(row, line))
        self.problems += [f"line {line}: {problem}" for problem in found]

    def _find_problems(self, row: Sequence[str], line: int) -> Iterator[str]:
        """Every problem of a row; a row without is added to the readings."""
        if len(row) != 1 + 2 * len(self.units):
            yield f"{len(row)} columns, but the header has {1 + 2 * len(self.units)}"
            return
        meter = parse_meter(row[0].strip(), self.meant)
        if isinstance(meter, str):
            yield meter
            return
        problems = list(find_meter_problems(self.network, [meter]))
        if meter.id in self.line_of:
            problems.append(f"meter {meter.id} has a reading in line {self.line_of[meter.id]} already; keep one")
        self.line_of.setdefault(meter.id, line)
        pairs = {unit: row[1 + 2 * i : 3 + 2 * i] for i, unit in enumerate(self.units)}
        filled = [unit for unit, pair in pairs.items() if any(cell.strip() for cell in pair)]
        if len(filled) != 1:
            problems.append(f"meter {meter.id}: fill exactly one pair of value and sigma, found {len(filled)}")
        elif meter.kind not in UNITS[filled[0]]:
            allowed = " or ".join(f"value_{unit},sigma_{unit}" for unit in UNITS if meter.kind in UNITS[unit])
            problems.append(f"meter {meter.id} cannot be in {filled[0]}; its columns are {allowed}")
        elif None in (numbers := [_number(cell) for cell in pairs[filled[0]]]):
            problems.append(
                f"meter {meter.id}: value and sigma must be finite numbers, found {pairs[filled[0]]!s:.200}"
            )
        elif not problems:
            value, sigma = (n * unit_size(filled[0], meter, self.network) for n in numbers if n is not None)
            problems += _find_value_problems(meter, value, sigma, self.network.base_mva)
            self.readings.append(Measurement(meter, value, sigma))
        yield from problems


def parse_meter(text: str, meant: Suggestions | None = None) -> Meter | str:
    """The meter with id ``text``, e.g. ``p_flow@3:3-4``; or what is wrong with the id. ``meant``: of many such ids."""
    kind_name, at, place = text.partition("@")
    bus, _, branch = place.partition(":")
    kinds = [str(kind) for kind in KIND]
    if not at or kind_name not in kinds or not bus.isdecimal() or len(bus) > LONGEST_BUS:
        close = (meant or Suggestions(kinds)).find(kind_name) if kind_name not in kinds else ""
        return (
            f"{text!r:.80} is no meter id; one looks like vm@1, p_injection@4 or p_flow@3:3-4 "
            f"(KIND@BUS or KIND@BUS:BRANCH, kinds: {', '.join(kinds)}){close}"
        )
    return Meter(KIND(kind_name), int(bus), branch or None)


def _find_value_problems(meter: Meter, value: float, sigma: float, base_mva: float) -> Iterable[str]:
    if not SMALLEST_SIGMA <= sigma <= LARGEST_SIGMA:
        yield (
            f"meter {meter.id}: sigma is {sigma:.3g} in p.u. or rad; it must lie between {SMALLEST_SIGMA:g} and "
            f"{LARGEST_SIGMA:g}"
        )
    if value < 0 and meter.kind in (KIND.VM, KIND.CURRENT):
        yield f"meter {meter.id}: the value is negative; a magnitude is not"
        return
    limits, size = _RANGES[meter.kind]
    yield from limits.find_problem(f"meter {meter.id}: the value", value * (base_mva if size is None else size))


_RANGES: Mapping[MeasurementKind, tuple[Range, float | None]] = {
    KIND.VM: (Range(0.0, VOLTAGE.most, VOLTAGE.unit), 1.0),  # a dead voltmeter reads 0
    KIND.VA: (ANGLE, math.degrees(1)),
    KIND.CURRENT: (Range(0.0, POWER.most, "MVA at the base voltage"), None),
    KIND.P_INJECTION: (POWER, None),
    KIND.P_FLOW: (POWER, None),
    KIND.Q_INJECTION: (REACTIVE_POWER, None),
    KIND.Q_FLOW: (REACTIVE_POWER, None),
}
"""Kind -> what it can read, and how large a p.u. or rad is in that unit; None: as ``base_mva``."""


def _number(cell: str) -> float | None:
    try:
        number = float(cell)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
