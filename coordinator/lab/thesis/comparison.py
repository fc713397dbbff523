"""``dsse thesis``: the tables of the thesis beside results of this program, as text and as one table of all rows."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from coordinator.lab.thesis.counterparts import COUNTERPARTS, Counterpart, ThesisRuns
from coordinator.watch.tables.text_table import format_table
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.files.wording import describe_unknown
from dsse_core.results.table import Table

CASES = ("industrial13", "ieee33")


@dataclass(frozen=True, slots=True)
class Misprint:
    """A printed number that must be wrong, in ``column`` (vm_pu or va_deg) of printed ``bus``.

    ``meant``: the intended number; None if not known.
    """

    table: str
    bus: int
    column: str
    printed: float
    meant: float | None
    why: str


@dataclass(frozen=True, slots=True)
class PrintedTable:
    """A printed table of states: ``buses`` as printed, ``vm_pu``, ``va_deg``, and its ``misprints``."""

    number: str
    case: str
    title: str
    buses: Sequence[int]
    vm_pu: Sequence[float]
    va_deg: Sequence[float]
    misprints: Sequence[Misprint]


@dataclass(frozen=True, slots=True)
class PrintedCase:
    """The printed tables of a case, by number.

    ``local_order``: area -> its buses in the order in which the thesis numbers them from 1.
    """

    tables: Mapping[str, PrintedTable]
    local_order: Mapping[str, Sequence[int]]


def load_case(case: str) -> PrintedCase:
    """The tables of ``case``, one of CASES, by their number."""
    path = files("coordinator.lab.thesis") / "tables" / f"{case}.json"
    content = parse_json(path.read_text(encoding="utf-8"))
    misprints = [Misprint(**entry) for entry in content["misprints"]]
    tables = {}
    for number, table in content["tables"].items():
        buses, vm, va_deg = list(zip(*table["rows"], strict=True))[:3]
        of_table = [m for m in misprints if m.table == number]
        tables[number] = PrintedTable(number, case, table["title"].strip(" ."), buses, vm, va_deg, of_table)
    return PrintedCase(tables, content["local_order"])


HEADER = ("bus", "of grid", "p.u. printed", "ours", "difference", "deg printed", "ours", "difference")
SUMMARY = ("table", "buses", "largest difference p.u.", "deg", "misprints", "ours")
COLUMN_PLACE = {"vm_pu": "magnitude", "va_deg": "angle"}


@dataclass(frozen=True)
class ComparedTable:
    """A printed table beside its counterpart, in the order of its rows.

    ``buses``: of the grid. ``vm_pu``, ``va_deg``: of the counterpart, shape (n_rows,).
    """

    printed: PrintedTable
    counterpart: Counterpart
    buses: Sequence[int]
    vm_pu: np.ndarray
    va_deg: np.ndarray

    def differences(self, column: str) -> np.ndarray:
        """Counterpart less the printed ``vm_pu`` or ``va_deg``, shape (n_rows,)."""
        return np.asarray(getattr(self, column) - np.array(getattr(self.printed, column)))

    def find_largest(self, column: str) -> float:
        """The largest absolute difference of ``column``, misprints left out."""
        wrong = {m.bus for m in self.printed.misprints if m.column == column}
        sizes = abs(self.differences(column))
        return float(max(size for bus, size in zip(self.printed.buses, sizes, strict=True) if bus not in wrong))


def compare_tables(numbers: Collection[str] = ()) -> list[ComparedTable]:
    """The tables with these ``numbers`` and their counterparts, in the order of the thesis; all tables without numbers.

    Raises:
        InvalidInputError: a number is not that of a table of states.
    """
    if unknown := [name for name in numbers if name not in COUNTERPARTS]:
        raise InvalidInputError("--table", [describe_unknown("table", name, tuple(COUNTERPARTS)) for name in unknown])
    runs, cases = ThesisRuns(), [load_case(case) for case in CASES]
    compared = []
    for number, counterpart in COUNTERPARTS.items():
        if numbers and number not in numbers:
            continue
        case = next(case for case in cases if number in case.tables)
        printed, states = case.tables[number], runs.find(counterpart)
        order = dict(enumerate(case.local_order[counterpart.area], start=1)) if counterpart.area else {}
        buses = [order.get(bus, bus) for bus in printed.buses]
        vm_pu, va_deg = np.array([states[bus] for bus in buses]).T
        compared.append(ComparedTable(printed, counterpart, buses, vm_pu, va_deg))
    return compared


def as_one_table(compared: Sequence[ComparedTable]) -> Table:
    """A table with one row per printed row. Column ``misprint`` describes the misprints of the row, or is empty."""
    columns: dict[str, list[object]] = {}
    for table in compared:
        printed = table.printed
        rows = {
            "table": [printed.number] * len(table.buses),
            "case": [printed.case] * len(table.buses),
            "printed_bus": printed.buses,
            "bus": table.buses,
            "printed_vm_pu": printed.vm_pu,
            "vm_pu": table.vm_pu,
            "difference_vm_pu": table.differences("vm_pu"),
            "printed_va_deg": printed.va_deg,
            "va_deg": table.va_deg,
            "difference_va_deg": table.differences("va_deg"),
            "misprint": [_describe_all(printed, bus) for bus in printed.buses],
            "ours": [table.counterpart.describe()] * len(table.buses),
        }
        for name, column in rows.items():
            columns.setdefault(name, []).extend(column)
    texts = ("table", "case", "misprint", "ours")
    return Table("thesis", {name: list(map(str, c)) if name in texts else np.array(c) for name, c in columns.items()})


def format_compared(table: ComparedTable) -> str:
    """A printed table beside its counterpart as text, its misprints marked by a star and explained."""
    printed = table.printed
    wrong = {m.bus for m in printed.misprints}
    rows = [
        (f"{bus}{' *' if bus in wrong else ''}", str(own), *_cells(*vm, 4), *_cells(*va, 4))
        for bus, own, vm, va in zip(
            printed.buses,
            table.buses,
            zip(printed.vm_pu, table.vm_pu, table.differences("vm_pu"), strict=True),
            zip(printed.va_deg, table.va_deg, table.differences("va_deg"), strict=True),
            strict=True,
        )
    ]
    notes = [f"* bus {m.bus}: {_describe(m)}" for m in printed.misprints]
    title = f"Table {printed.number}: {printed.title}\nours: {table.counterpart.describe()}"
    return "\n".join([title, format_table(HEADER, rows), *notes])


def format_summary(compared: Sequence[ComparedTable]) -> str:
    """A line per table with its largest differences, misprints left out."""
    rows = [
        (
            *(table.printed.number, str(len(table.buses))),
            *(f"{table.find_largest('vm_pu'):.4f}", f"{table.find_largest('va_deg'):.4f}"),
            *(str(len(table.printed.misprints) or "-"), table.counterpart.describe()),
        )
        for table in compared
    ]
    return format_table(SUMMARY, rows)


def _cells(printed: float, ours: float, difference: float, digits: int) -> Iterator[str]:
    yield f"{printed:g}"
    yield f"{ours:.{digits}f}"
    yield f"{difference:+.{digits}f}"


def _describe(misprint: Misprint) -> str:
    meant = f" for {misprint.meant:g}" if misprint.meant is not None else ""
    return f"misprint: {COLUMN_PLACE[misprint.column]} {misprint.printed:g}{meant}; {misprint.why}"


def _describe_all(printed: PrintedTable, bus: int) -> str:
    return "; ".join(_describe(m) for m in printed.misprints if m.bus == bus)
