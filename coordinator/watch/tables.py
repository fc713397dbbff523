"""Tables as aligned text; tables of results as CSV, JSON and Parquet, every number exact."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.files.drafts import whole_file
from dsse_core.files.installation import install_command
from dsse_core.printable import printable
from dsse_core.results.results import Results
from dsse_core.results.scans import ScanTables
from dsse_core.results.table import Table, write_times

Tables = Results | ScanTables
Column = np.ndarray | tuple[str, ...]


def write_tables(folder: Path, tables: Tables) -> None:
    """Write ``buses.csv`` and so on for each of ``tables``."""
    for name in tables.names:
        path = folder / f"{name}.csv"
        with whole_file(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
            getattr(tables, name).to_csv(file)


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
    if isinstance(column, tuple):
        return column
    if column.dtype.kind == "M":
        return [text or None for text in write_times(column)]
    if column.dtype.kind != "f":
        return list(column.tolist())
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
        problem = f"pyarrow, which writes it, is not installed; {install_command('parquet')}"
        raise InvalidInputError("--parquet", [problem]) from None
    return pyarrow, pyarrow.parquet


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Table of columns padded to their widest cell, all printable; the first is flush left, the others right."""
    columns = [list(map(printable, column)) for column in zip(*rows, strict=True)] if rows else [[] for _ in header]
    table = [[name, *column] for name, column in zip(header, columns, strict=True)]
    widths = [max(map(len, column)) for column in table]
    row = "  ".join(f"%{width if k else -width}s" for k, width in enumerate(widths))
    return "\n".join([(row % cells).rstrip() for cells in zip(*table, strict=True)])
