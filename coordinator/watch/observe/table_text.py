"""Tables of buses and meters as lines of a terminal: the columns that fit, numbers aligned."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from dsse_core.printable import printable, shortened
from dsse_core.results.table import ALL_PHASES, Table, name_by_phase

NUMBERS = "vm_pu", "va_deg", "sigma_vm_pu", "p_kw", "q_kvar"
BUSES_FIRST = "node", "bus", "area", "quality", "value_age_s", *NUMBERS  # columns in order, as far as they fit
METERS_FIRST = "meter", "area", "status", "normalised_residual", "reading", "estimate", "unit", "quality", "value_age_s"
OF_UNITS = "reading", "estimate", "sigma"  # columns in which each meter has its own unit
DIGITS = 5  # significant digits of a number
MOST_DECIMALS = 7
LONGEST_CELL = 24
LARGEST = 1e9  # larger numbers have an exponent


def write_table(table: Table, width: int, most: int | None) -> Iterator[str]:
    """Lines of ``width`` characters at most: ``most`` rows, for buses those with voltages farthest from 1 p.u.

    Rows of buses with phases are named by their nodes, such as 671.a.
    """
    table = _name_nodes(table)
    rows = _choose_rows(table, most)
    first = METERS_FIRST if "meter" in table.columns else BUSES_FIRST
    order = dict.fromkeys((*(name for name in first if name in table.columns), *table.columns))
    known = [name for name in order if not _is_unknown(table[name])]
    columns = [[name, *_write_column(_pick(table[name], rows), name in OF_UNITS)] for name in known]
    widths = [max(map(len, column)) for column in columns]
    fitting = int(np.searchsorted(np.cumsum([width + 2 for width in widths]), width + 2, side="right"))
    right = [isinstance(table[name], np.ndarray) for name in known]
    for row in zip(*columns[:fitting], strict=True):
        cells = zip(row, widths, right, strict=False)
        yield "  ".join(cell.rjust(wide) if is_number else cell.ljust(wide) for cell, wide, is_number in cells).rstrip()
    if len(rows) < len(table):
        yield f"... and {len(table) - len(rows)} rows more: --once shows all"


def _name_nodes(table: Table) -> Table:
    """``table`` with the column ``node`` in place of ``bus`` and ``phase``, where buses have phases."""
    if not {"bus", "phase"} <= {*table.columns} or {*table.phase} <= {ALL_PHASES}:
        return table
    nodes = {"node": name_by_phase(map(str, table.bus.tolist()), table.phase)}
    return Table("nodes", nodes | {name: table[name] for name in table.columns if name not in ("bus", "phase")})


def _choose_rows(table: Table, most: int | None) -> list[int]:
    if most is None or most >= len(table):
        return list(range(len(table)))
    if "vm_pu" not in table.columns:
        return list(range(most))
    far = np.nan_to_num(np.abs(table.vm_pu - 1.0), nan=-1.0)
    return sorted(np.argsort(-far, kind="stable")[:most].tolist())


def _pick(column: np.ndarray | tuple[str, ...], rows: Sequence[int]) -> list[object]:
    return [column[k].item() if isinstance(column, np.ndarray) else column[k] for k in rows]


def _write_column(values: Sequence[object], differ_in_unit: bool) -> list[str]:
    """Cells with as many decimals as the largest number needs; cell by cell where rows ``differ_in_unit``."""
    sizes = [abs(value) for value in values if isinstance(value, float) and 0.0 < abs(value) < LARGEST]
    if differ_in_unit or not sizes:
        return [_cell(value, None) for value in values]
    decimals = _decimals_of(max(sizes))
    cells = [f"{value:.{decimals}f}" for value in sizes]
    while decimals and all(cell.endswith("0") for cell in cells):
        decimals, cells = decimals - 1, [cell[:-1] for cell in cells]
    return [_cell(value, decimals) for value in values]


def _decimals_of(size: float) -> int:
    return min(MOST_DECIMALS, max(0, DIGITS - 1 - math.floor(math.log10(size))))


def _cell(value: object, decimals: int | None) -> str:
    if not isinstance(value, float):
        return shortened(printable(value), LONGEST_CELL)
    if math.isnan(value):
        return "-"
    if abs(value) >= LARGEST:
        return f"{value:.{DIGITS - 1}g}"
    if value == 0.0:
        return "0"
    return f"{value:.{_decimals_of(abs(value)) if decimals is None else decimals}f}"


def _is_unknown(column: np.ndarray | tuple[str, ...]) -> bool:
    """True where no row has a value in this column."""
    if isinstance(column, tuple):
        return not any(column)
    return column.dtype.kind in "fM" and bool(np.isnan(column).all())
