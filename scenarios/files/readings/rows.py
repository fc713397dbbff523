"""Row-by-row reader of a readings file, with every problem of each row."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from dsse_core.files.wording import Suggestions, suggest
from dsse_core.grid.measurement import (
    KIND_OF,
    Measurement,
    MeasurementKind,
    Meter,
    explain_no_meter,
    find_meter_problems,
    read_meter_id,
)
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import list_phases
from dsse_core.limits import LARGEST_SIGMA, SMALLEST_SIGMA
from scenarios.files.readings.units import RANGES, UNITS, size_of_range, unit_size
from scenarios.injections import Injections

KIND = MeasurementKind
SCAN = "scan"
OTHER_SEPARATORS = ";\t|"


@dataclass
class ReadingRows:
    """The rows read so far, and their problems. ``scans``: of each reading, "" without such a column.

    ``takes_scans``: true where the second column may be ``scan``.
    """

    network: Network
    takes_scans: bool = False
    keys: list[str] = field(default_factory=lambda: ["meter"])
    units: list[str] = field(default_factory=list)
    readings: list[Measurement] = field(default_factory=list)
    scans: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    line_of: dict[tuple[object, ...], tuple[int, str]] = field(default_factory=dict)
    meant: Suggestions = field(default_factory=lambda: Suggestions(list(KIND)))

    @cached_property
    def injections(self) -> Injections:
        return Injections(self.network)

    @property
    def takes_many(self) -> bool:
        """True where there is a column ``scan``."""
        return SCAN in self.keys

    def take_header(self, header: Sequence[str], line: int = 1) -> None:
        """Take the titles of the columns, which stand in ``line``."""
        self.problems += [f"line {line}: {problem}" for problem in self._find_header_problems(header)]

    def _find_header_problems(self, header: Sequence[str]) -> Iterator[str]:
        if list(header[1:2]) == [SCAN]:
            if not self.takes_scans:
                yield (
                    "column 'scan': a scenario has one scan; remove the column, or give the file to "
                    "`dsse estimate SCENARIO --readings FILE`"
                )
                return
            self.keys = ["meter", SCAN]
        keys = ["meter", SCAN] if self.takes_scans else ["meter"]
        allowed = [*keys, *(f"{column}_{unit}" for unit in UNITS for column in ("value", "sigma"))]
        if len(header) == 1 and (other := next((mark for mark in OTHER_SEPARATORS if mark in header[0]), "")):
            yield f"the columns are separated by {other!r}; separate them by ','"
            return
        if not header or header[0] != "meter":
            found = f"{header[0]!r:.80}" if header else "an empty file"
            yield f"the first column must be 'meter', found {found}"
        unknown = [name for name in header if name not in allowed]
        for name in unknown:
            yield f"unknown column {name!r:.80}; allowed: {', '.join(allowed)}{suggest(name, allowed)}"
        self.units = [name.removeprefix("value_") for name in header if name.startswith("value_")]
        expected = [*self.keys, *(f"{column}_{unit}" for unit in self.units for column in ("value", "sigma"))]
        is_sound = list(header) == expected and len(set(header)) == len(header) and self.units
        if header and header[0] == "meter" and not (unknown or is_sound):
            before = " and, of many scans, ".join(map(repr, keys))
            yield (
                f"after {before} come pairs value_UNIT,sigma_UNIT of one unit, each unit once; found "
                + ",".join(header)[:200]
            )

    def take(self, row: Sequence[str], line: int) -> None:
        if not any(cell.strip() for cell in row):
            return
        found = list(self._find_problems(row, line))
        self.problems += [f"line {line}: {problem}" for problem in found]

    def _find_problems(self, row: Sequence[str], line: int) -> Iterator[str]:
        """Every problem of a row. A row without a problem is added to the readings."""
        first = len(self.keys)
        if len(row) != first + 2 * len(self.units):
            yield f"{len(row)} columns, but the header has {first + 2 * len(self.units)}"
            return
        scan = row[1].strip() if self.takes_many else ""
        if self.takes_many and not scan:
            yield "column scan is empty; say to which scan the reading belongs"
        meter = parse_meter(row[0].strip(), self.meant)
        if isinstance(meter, str):
            yield meter
            return
        problems = list(find_meter_problems(self.network, [meter])) or list(find_leg_problems(self.injections, [meter]))
        first_line, first_id = self.line_of.setdefault((scan, *meter.quantity), (line, meter.id))
        if first_line != line:
            of_scan = f" of scan {scan!r:.80}" if scan else ""
            called = "" if first_id == meter.id else f", as {first_id}"
            problems.append(f"meter {meter.id} has a reading{of_scan} in line {first_line} already{called}; keep one")
        pairs = {unit: row[first + 2 * i : first + 2 * i + 2] for i, unit in enumerate(self.units)}
        filled = [unit for unit, pair in pairs.items() if any(cell.strip() for cell in pair)]
        if len(filled) != 1:
            problems.append(f"meter {meter.id}: fill exactly one pair of value and sigma, found {len(filled)}")
        elif meter.kind.quantity not in UNITS[filled[0]]:
            allowed = " or ".join(f"value_{unit},sigma_{unit}" for unit in UNITS if meter.kind.quantity in UNITS[unit])
            problems.append(f"meter {meter.id} cannot be in {filled[0]}; its columns are {allowed}")
        elif None in (numbers := [_number(cell) for cell in pairs[filled[0]]]):
            problems.append(
                f"meter {meter.id}: value and sigma must be finite numbers, found {pairs[filled[0]]!s:.200}"
            )
        elif not problems:
            value, sigma = (n * unit_size(filled[0], meter, self.network) for n in numbers if n is not None)
            problems += _find_value_problems(meter, value, sigma, self.network)
            self.readings.append(Measurement(meter, value, sigma))
            self.scans.append(scan)
        yield from problems


def find_leg_problems(injections: Injections, meters: Iterable[Meter]) -> Iterator[str]:
    """Meters of the power between two phases, of the network's buses, that cannot read it, as text."""
    for meter in meters:
        if meter.kind.of_injection and len(list_phases(meter.phases)) == 2:
            problem, cure = injections.find_problem_of_leg(meter.bus, meter.phases)
            if problem:
                yield f"meter {meter.id}: {problem}; {cure}"


def parse_meter(text: str, meant: Suggestions | None = None) -> Meter | str:
    """The meter with id ``text``, e.g. ``p_flow@3:3-4``; a problem as text for no id. ``meant``: of many such ids."""
    if (meter := read_meter_id(text)) is not None:
        return meter
    kind_name = text.partition("@")[0]
    close = "" if kind_name in KIND_OF else (meant or Suggestions(list(KIND_OF))).find(kind_name)
    return explain_no_meter(text) + close


def _find_value_problems(meter: Meter, value: float, sigma: float, network: Network) -> Iterable[str]:
    if not SMALLEST_SIGMA <= sigma <= LARGEST_SIGMA:
        yield (
            f"meter {meter.id}: sigma is {sigma:.3g} in p.u. or rad; it must lie between {SMALLEST_SIGMA:g} and "
            f"{LARGEST_SIGMA:g}"
        )
    if value < 0 and meter.kind.quantity.is_magnitude:
        yield f"meter {meter.id}: the value is negative; a magnitude is not"
        return
    limits, _ = RANGES[meter.kind.quantity]
    yield from limits.find_problem(f"meter {meter.id}: the value", value * size_of_range(meter, network))


def _number(cell: str) -> float | None:
    try:
        number = float(cell)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
