"""Tables of results as files and texts: CSV, JSON and Parquet, every number exact."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, TextIO

import msgspec
import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.files.drafts import whole_file
from dsse_core.results.results import Results
from dsse_core.results.scans import ScanTables
from dsse_core.results.table import Table

Tables = Results | ScanTables
Column = np.ndarray | tuple[str, ...]
ROWS_AT_A_TIME = 4096  # whose cells take a few megabytes
NEEDS_QUOTES = re.compile('[,"\r\n]')


def write_tables(folder: Path, tables: Tables) -> None:
    """Write ``buses.csv`` and so on for each of ``tables``."""
    for name in tables.names:
        path = folder / f"{name}.csv"
        with whole_file(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
            write_csv(file, getattr(tables, name))


def format_csv(table: Table) -> str:
    """The table as CSV text, without the last line end."""
    text = io.StringIO(newline="")
    write_csv(text, table)
    return text.getvalue().rstrip("\n")


def write_csv(file: TextIO, table: Table) -> None:
    """Write a header and one line per row; numbers read back exactly, and an unknown value is an empty cell."""
    file.write(",".join(table.columns) + "\n")
    columns = [table[name] for name in table.columns]
    groups = [(is_text, list(group)) for is_text, group in groupby(columns, key=_is_text)]
    for first in range(0, len(table), ROWS_AT_A_TIME):
        parts: list[Sequence[str]] = []
        for is_text, group in groups:
            cut = [column[first : first + ROWS_AT_A_TIME] for column in group]
            parts += map(_quote, cut) if is_text else [_join_numbers(cut)]
        file.write("\n".join(map(",".join, zip(*parts, strict=True))) + "\n")


def _is_text(column: Column) -> bool:
    return isinstance(column, tuple) or column.dtype.kind not in "biuf"


def _quote(texts: Column) -> Sequence[str]:
    """Texts as cells, in quotes where they contain a comma, a quote or a line end."""
    cells = texts if isinstance(texts, tuple) else list(map(str, texts.tolist()))
    if not NEEDS_QUOTES.search("".join(cells)):
        return cells
    return ['"' + cell.replace('"', '""') + '"' if NEEDS_QUOTES.search(cell) else cell for cell in cells]


def _join_numbers(columns: Sequence[np.ndarray]) -> list[str]:
    """The cells of each row, with commas between them.

    One call of ``msgspec`` writes all numbers, in a fifth of the time of Python's ``repr`` of each.
    """
    text = msgspec.json.encode(list(zip(*map(_as_numbers, columns), strict=True))).decode()
    return text[len("[[") : -len("]]")].replace("null", "").split("],[")


def _as_numbers(column: np.ndarray) -> list[object]:
    """The numbers of ``column`` for ``msgspec``; those that it would write otherwise than Python as raw text.

    The two differ in exponents of one digit and of large numbers."""
    numbers: list[object] = column.tolist()
    if column.dtype.kind == "f":
        size = abs(column)
        alike = (size < 1e-9) | (size >= 1e-4) & (size < 1e16) | np.isnan(size)
        for row in np.flatnonzero(~alike).tolist():
            numbers[row] = msgspec.Raw(repr(numbers[row]).encode())
    return numbers


def write_json(path: Path, content: object) -> None:
    """Write ``content``, in which no number may be nan or infinite."""
    with whole_file(path) as draft:
        draft.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def tables_as_json(tables: Tables) -> dict[str, list[dict[str, Any]]]:
    """Table -> its rows, each with all columns as keys; None for unknown values."""
    return {name: rows_as_json(getattr(tables, name)) for name in tables.names}


def rows_as_json(table: Table) -> list[dict[str, Any]]:
    """The rows, each with all columns as keys; None for unknown values."""
    columns = [_as_values(table[name]) for name in table.columns]
    return [dict(zip(table.columns, row, strict=True)) for row in zip(*columns, strict=True)]


def columns_as_json(table: Table) -> dict[str, list[Any]]:
    """The columns by their names; None for unknown values."""
    return {name: list(_as_values(table[name])) for name in table.columns}


def _as_values(column: Column) -> Iterable[object]:
    if isinstance(column, tuple) or column.dtype.kind != "f":
        return column if isinstance(column, tuple) else column.tolist()
    return [value if math.isfinite(value) else None for value in column.tolist()]


def check_parquet() -> None:
    """Check that Parquet can be written.

    Raises:
        InvalidInputError: pyarrow is not installed.
    """
    _load_pyarrow()


def write_parquet(folder: Path, tables: Tables) -> None:
    """Write ``buses.parquet`` and so on; unknown values are null.

    Raises:
        InvalidInputError: pyarrow is not installed.
    """
    pyarrow, parquet = _load_pyarrow()
    for name in tables.names:
        table: Table = getattr(tables, name)
        columns = {key: pyarrow.array(table[key], from_pandas=True) for key in table.columns}
        with whole_file(folder / f"{name}.parquet") as draft, draft.open("wb") as file:
            parquet.write_table(pyarrow.table(columns), file)


def _load_pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        problem = "pyarrow, which writes it, is not installed; pip install 'consensus-dsse[parquet]'"
        raise InvalidInputError("--parquet", [problem]) from None
    return pyarrow, pyarrow.parquet
