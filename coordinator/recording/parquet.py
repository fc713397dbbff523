"""Rows of a recording as Parquet files, and back. pyarrow is imported here only when it is needed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from coordinator.recording.rows import COLUMNS, INTEGER, NUMBER, TEXT, TEXTS, TIME, TRUTH, Row
from dsse_core.errors import InvalidInputError

ROWS_AT_ONCE = 50_000  # that are held in memory, of each table
MICROSECONDS = 1_000_000


def has_parquet() -> bool:
    """Whether Parquet can be written and read."""
    try:
        _load_pyarrow("")
    except InvalidInputError:
        return False
    return True


def write_rows(rows: Iterable[Row], folder: Path) -> list[str]:
    """Write ``<table>.parquet`` in ``folder`` of each table that has rows; their names. On the disk when it returns.

    Raises:
        InvalidInputError: pyarrow is not installed.
        OSError: naming the file that cannot be written.
    """
    pyarrow, parquet = _load_pyarrow(str(folder))
    waiting: dict[str, list[tuple[Any, ...]]] = {table: [] for table in COLUMNS}
    writers: dict[str, Any] = {}

    def write(table: str) -> None:
        schema = _schema_of(pyarrow, table)
        if table not in writers:
            writers[table] = parquet.ParquetWriter(folder / f"{table}.parquet", schema, compression="zstd")
        columns = zip(*waiting[table], strict=True)
        kinds = COLUMNS[table].values()
        arrays = [_to_array(pyarrow, kind, column) for kind, column in zip(kinds, columns, strict=True)]
        writers[table].write_table(pyarrow.Table.from_arrays(arrays, schema=schema))
        waiting[table].clear()

    try:
        for table, row in rows:
            waiting[table].append(row)
            if len(waiting[table]) >= ROWS_AT_ONCE:
                write(table)
        for table, left in waiting.items():
            if left:
                write(table)
    finally:
        for writer in writers.values():
            with contextlib.suppress(OSError):
                writer.close()
    for table in writers:
        sync_path(folder / f"{table}.parquet")
    return list(writers)


def read_rows(path: Path, columns: Sequence[str], added: Collection[str] = ()) -> Iterator[tuple[Any, ...]]:
    """The values of ``columns`` in each row of the file at ``path``; times in s since 1970. Those of ``added`` that it
    lacks are None.

    Raises:
        InvalidInputError: it cannot be read, or pyarrow is not installed.
    """
    pyarrow, parquet = _load_pyarrow(str(path))
    try:
        with parquet.ParquetFile(path) as file:
            lacking = {*added} - {*file.schema_arrow.names}
            for batch in file.iter_batches(ROWS_AT_ONCE, columns=[name for name in columns if name not in lacking]):
                unknown = [None] * batch.num_rows
                values = [unknown if name in lacking else _from_array(pyarrow, batch.column(name)) for name in columns]
                yield from zip(*values, strict=True)
    except (OSError, KeyError, pyarrow.ArrowException) as error:
        problem = f"is no table of a recording: {str(error).splitlines()[0][:200]}; move it elsewhere"
        raise InvalidInputError(str(path), [problem]) from None


def sync_path(path: Path) -> None:
    """Have a file, or what a folder lists, on the disk."""
    file = os.open(path, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            os.fsync(file)
    finally:
        os.close(file)


def _schema_of(pyarrow: Any, table: str) -> Any:
    types = {
        TIME: pyarrow.timestamp("us"),  # of UTC; with a zone DuckDB hands it over only where pytz is installed
        INTEGER: pyarrow.int64(),
        NUMBER: pyarrow.float64(),
        TRUTH: pyarrow.bool_(),
        TEXT: pyarrow.string(),
        TEXTS: pyarrow.list_(pyarrow.string()),
    }
    return pyarrow.schema([(name, types[kind]) for name, kind in COLUMNS[table].items()])


def _to_array(pyarrow: Any, kind: str, column: Sequence[Any]) -> Any:
    if kind == TIME:
        whole = [None if value is None else round(value * MICROSECONDS) for value in column]
        return pyarrow.array(whole, pyarrow.int64()).cast(pyarrow.timestamp("us"))
    if kind == NUMBER:
        return pyarrow.array(column, pyarrow.float64(), from_pandas=True)  # nan is not known
    types = {INTEGER: pyarrow.int64(), TRUTH: pyarrow.bool_(), TEXT: pyarrow.string()}
    return pyarrow.array(column, types.get(kind, pyarrow.list_(pyarrow.string())))


def _from_array(pyarrow: Any, array: Any) -> list[Any]:
    if pyarrow.types.is_timestamp(array.type):
        whole = array.cast(pyarrow.int64()).to_pylist()
        return [None if value is None else value / MICROSECONDS for value in whole]
    return list(array.to_pylist())


def _load_pyarrow(what: str) -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        problem = "pyarrow, which reads and writes Parquet, is not installed; pip install 'consensus-dsse[parquet]'"
        raise InvalidInputError(what, [problem]) from None
    return pyarrow, pyarrow.parquet
