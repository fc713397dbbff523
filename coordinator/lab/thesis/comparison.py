"""``dsse thesis``: the tables of the thesis beside results of this program, as text and as one table of all rows."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from coordinator.lab.thesis.counterparts import BASES, COUNTERPARTS, QUANTITIES, Counterpart, ThesisRuns
from coordinator.watch.tables import format_table
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.files.wording import describe_unknown
from dsse_core.results.table import Table

CASES = ("industrial13", "ieee33")


@dataclass(frozen=True, slots=True)
class Misprint:
    """A printed number that must be wrong, in ``column`` (vm_pu or va_deg) of printed ``bus``.

    ``meant``: the intended number; None if not known. ``probable``: the number could be meant, but fits nothing else.
    """

    table: str
    bus: int
    column: str
    printed: float
    meant: float | None
    why: str
    probable: bool = False


@dataclass(frozen=True, slots=True)
class PrintedTable:
    """A printed table: ``buses`` as printed, its ``columns``, a part of QUANTITIES, and its ``misprints``."""

    number: str
    case: str
    title: str
    buses: Sequence[int]
    columns: Mapping[str, Sequence[float]]
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
        buses, *columns = zip(*table["rows"], strict=True)
        of_table = [m for m in misprints if m.table == number]
        named = dict(zip(QUANTITIES, columns, strict=False))
        tables[number] = PrintedTable(number, case, table["title"].strip(" ."), buses, named, of_table)
    return PrintedCase(tables, content["local_order"])


HEADER = ("bus", "of grid", "p.u. printed", "ours", "difference", "deg printed", "ours", "difference")
POWERS = (
    "bus",
    *(f"{name} {side}" for name in ("load MW", "load Mvar", "gen MW", "gen Mvar") for side in ("printed", "ours")),
)
SUMMARY = ("table", "buses", "largest difference p.u.", "deg", "MW", "Mvar", "misprints", "ours")
EFFECTS = ("table", "against", "largest effect p.u. printed", "ours", "deg printed", "ours")
COLUMN_PLACE = {"vm_pu": "magnitude", "va_deg": "angle"}


@dataclass(frozen=True)
class ComparedTable:
    """A printed table beside its counterpart, in the order of its rows.

    ``buses``: of the grid. ``columns``: of the counterpart, those that are printed, shape (n_rows,) each. ``base``: the
    table that this one shows an effect against.
    """

    printed: PrintedTable
    counterpart: Counterpart
    buses: Sequence[int]
    columns: Mapping[str, np.ndarray]
    base: ComparedTable | None

    def differences(self, column: str) -> np.ndarray:
        """Counterpart less what is printed in ``column``, shape (n_rows,)."""
        return np.asarray(self.columns[column] - np.array(self.printed.columns[column]))

    def find_largest(self, *columns: str) -> float:
        """The largest absolute difference of ``columns``, misprints left out; nan where none is printed."""
        sizes = [abs(self.differences(name))[self.are_sound(name)] for name in columns if name in self.columns]
        return float(np.concatenate(sizes).max()) if sizes else np.nan

    def are_sound(self, column: str) -> np.ndarray:
        """True where ``column`` is no misprint, (n_rows,)."""
        wrong = {m.bus for m in self.printed.misprints if m.column == column}
        return np.array([bus not in wrong for bus in self.printed.buses])

    def effects(self, column: str) -> np.ndarray:
        """Difference of each row to that of ``base``, as printed and of the counterparts, (2, n_rows).

        nan where there is none, or one of the printed numbers is a misprint.
        """
        found = np.full((2, len(self.buses)), np.nan)
        if self.base is not None:
            row = {bus: k for k, bus in enumerate(self.base.buses)}
            at = [row[bus] for bus in self.buses]
            printed, of_base = (np.array(side.columns[column]) for side in (self.printed, self.base.printed))
            found[:] = printed - of_base[at], self.columns[column] - self.base.columns[column][at]
            found[:, ~(self.are_sound(column) & self.base.are_sound(column)[at])] = np.nan
        return found


def compare_tables(numbers: Collection[str] = ()) -> list[ComparedTable]:
    """The tables with these ``numbers`` and their counterparts, in the order of the thesis; all tables without numbers.

    Raises:
        InvalidInputError: a number is not that of a table of states.
    """
    if unknown := [name for name in numbers if name not in COUNTERPARTS]:
        raise InvalidInputError("--table", [describe_unknown("table", name, tuple(COUNTERPARTS)) for name in unknown])
    runs, cases = ThesisRuns(), [load_case(case) for case in CASES]
    compared = []
    for number in COUNTERPARTS:
        if not numbers or number in numbers:
            compared.append(_compare(number, runs, cases))
    return compared


def _compare(number: str, runs: ThesisRuns, cases: Sequence[PrintedCase]) -> ComparedTable:
    counterpart, case = COUNTERPARTS[number], next(case for case in cases if number in case.tables)
    printed, states = case.tables[number], runs.find(counterpart)
    order = dict(enumerate(case.local_order[counterpart.area], start=1)) if counterpart.area else {}
    buses = [order.get(bus, bus) for bus in printed.buses]
    columns = dict(zip(printed.columns, np.array([states[bus] for bus in buses]).T, strict=True))
    base = _compare(BASES[number], runs, cases) if number in BASES else None
    return ComparedTable(printed, counterpart, buses, columns, base)


def as_one_table(compared: Sequence[ComparedTable]) -> Table:
    """A table with one row per printed row. Column ``misprint`` describes the misprints of the row, or is empty.

    Of each of QUANTITIES ``printed_`` and ``difference_``, of the states ``printed_effect_`` and ``effect_`` as well.
    """
    columns: dict[str, list[object]] = {}
    for table in compared:
        printed, nothing = table.printed, np.full(len(table.buses), np.nan)
        rows: dict[str, Sequence[object] | np.ndarray] = {
            "table": [printed.number] * len(table.buses),
            "case": [printed.case] * len(table.buses),
            "printed_bus": printed.buses,
            "bus": table.buses,
        }
        for name in QUANTITIES:
            is_printed = name in printed.columns
            rows[f"printed_{name}"] = printed.columns.get(name, nothing)
            rows[name] = table.columns.get(name, nothing)
            rows[f"difference_{name}"] = table.differences(name) if is_printed else nothing
        rows["misprint"] = [_describe_all(printed, bus) for bus in printed.buses]
        rows["ours"] = [table.counterpart.describe()] * len(table.buses)
        rows["against"] = [table.base.printed.number if table.base else ""] * len(table.buses)
        for name in COLUMN_PLACE:
            rows[f"printed_effect_{name}"], rows[f"effect_{name}"] = table.effects(name)
        for name, column in rows.items():
            columns.setdefault(name, []).extend(column)
    texts = ("table", "case", "misprint", "ours", "against")
    return Table("thesis", {name: list(map(str, c)) if name in texts else np.array(c) for name, c in columns.items()})


def format_compared(table: ComparedTable) -> str:
    """A printed table beside its counterpart as text, its misprints marked by a star and explained."""
    printed = table.printed
    wrong = {m.bus for m in printed.misprints}
    names = [f"{bus}{' *' if bus in wrong else ''}" for bus in printed.buses]
    vm_va = [
        zip(printed.columns[name], table.columns[name], table.differences(name), strict=True) for name in COLUMN_PLACE
    ]
    rows = [
        (name, str(own), *_cells(*vm), *_cells(*va))
        for name, own, vm, va in zip(names, table.buses, *vm_va, strict=True)
    ]
    notes = [f"* bus {m.bus}: {_describe(m)}" for m in printed.misprints]
    title = f"Table {printed.number}: {printed.title}\nours: {table.counterpart.describe()}"
    parts = [title, format_table(HEADER, rows), *notes]
    if powers := [name for name in QUANTITIES[2:] if name in printed.columns]:
        sides = [side for name in powers for side in (printed.columns[name], table.columns[name])]
        rounded = np.round(np.array(sides), 3).T + 0.0  # without a negative zero
        of_rows = [
            (name, *map("{:.3f}".format, row)) for name, row in zip(names, rounded.tolist(), strict=True) if any(row)
        ]
        parts.append(format_table(POWERS, of_rows))
    if table.base is not None:
        parts.append(format_effects([table]))
    return "\n".join(parts)


def format_summary(compared: Sequence[ComparedTable]) -> str:
    """A line per table with its largest differences, and one per effect, misprints left out."""
    rows = [
        (
            *(table.printed.number, str(len(table.buses))),
            *(_or_dash(table.find_largest(name), 4) for name in COLUMN_PLACE),
            *(_or_dash(table.find_largest(f"load_{unit}", f"gen_{unit}"), 3) for unit in ("mw", "mvar")),
            *(str(len(table.printed.misprints) or "-"), table.counterpart.describe()),
        )
        for table in compared
    ]
    with_base = [table for table in compared if table.base is not None]
    return "\n\n".join([format_table(SUMMARY, rows), *([format_effects(with_base)] if with_base else [])])


def format_effects(compared: Sequence[ComparedTable]) -> str:
    """A line per table that shows an effect against another one: how large it is as printed, and here."""
    rows = []
    for table in compared:
        assert table.base is not None
        sizes = [np.nanmax(abs(table.effects(name)), axis=1).tolist() for name in COLUMN_PLACE]
        rows.append(
            (table.printed.number, table.base.printed.number, *(f"{size:.4f}" for pair in sizes for size in pair))
        )
    return format_table(EFFECTS, rows)


def _or_dash(size: float, digits: int) -> str:
    return "-" if np.isnan(size) else f"{size:.{digits}f}"


def _cells(printed: float, ours: float, difference: float) -> Iterator[str]:
    yield f"{printed:g}"
    yield f"{ours:.4f}"
    yield f"{difference:+.4f}"


def _describe(misprint: Misprint) -> str:
    meant = f" for {misprint.meant:g}" if misprint.meant is not None else ""
    kind = "probable misprint" if misprint.probable else "misprint"
    return f"{kind}: {COLUMN_PLACE[misprint.column]} {misprint.printed:g}{meant}; {misprint.why}"


def _describe_all(printed: PrintedTable, bus: int) -> str:
    return "; ".join(_describe(m) for m in printed.misprints if m.bus == bus)
