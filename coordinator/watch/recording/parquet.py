"""Rows of a recording as Parquet files, and back. pyarrow is imported here only when it is needed."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from coordinator.watch.recording.parquet_pages import read_pages
from coordinator.watch.recording.recorded_tables import COLUMNS, INTEGER, NUMBER, TEXT, TEXTS, TIME, TRUTH, Row
from coordinator.watch.recording.row_checks import RowCheck
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import open_regular
from dsse_core.files.installation import install_command

ROWS_AT_ONCE = 50_000  # of each table that are held in memory
TEXT_AT_ONCE = 2**24  # characters of these rows, in tables with long texts
TEXT_TABLES = ("states", "events")
MOST_ROWS = 5_000_000  # of a file that is read; an hour of 1,000 buses with a scan a second has 3.6 million
LARGEST_GROUP = 2**26  # bytes of rows that are written together, as they are in memory
MICROSECONDS = 1_000_000


def has_parquet() -> bool:
    """True where Parquet can be written and read, because pyarrow is installed."""
    try:
        _load_pyarrow("")
    except InvalidInputError:
        return False
    return True


def write_rows(rows: Iterable[Row], folder: Path) -> list[str]:
    """Writes ``<table>.parquet`` in ``folder`` for each table that has rows, and returns the names of these tables.

    The files are on the disk when it returns.

    Raises:
        InvalidInputError: pyarrow is not installed.
        OSError: naming the file that cannot be written.
    """
    pyarrow, parquet = _load_pyarrow(str(folder))
    waiting: dict[str, list[tuple[Any, ...]]] = {table: [] for table in COLUMNS}
    writers: dict[str, Any] = {}
    characters = dict.fromkeys(TEXT_TABLES, 0)

    def write(table: str) -> None:
        schema = _schema_of(pyarrow, table)
        if table not in writers:
            writers[table] = parquet.ParquetWriter(folder / f"{table}.parquet", schema, compression="zstd")
        columns = zip(*waiting[table], strict=True)
        kinds = COLUMNS[table].values()
        arrays = [_to_array(pyarrow, kind, column) for kind, column in zip(kinds, columns, strict=True)]
        writers[table].write_table(pyarrow.Table.from_arrays(arrays, schema=schema))
        waiting[table].clear()
        characters[table] = 0

    try:
        for table, row in rows:
            waiting[table].append(row)
            if table in TEXT_TABLES:
                characters[table] += sum(map(_count_characters, row))
            if len(waiting[table]) >= ROWS_AT_ONCE or characters.get(table, 0) >= TEXT_AT_ONCE:
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


def _count_characters(value: Any) -> int:
    if isinstance(value, list):
        return sum(map(len, value))
    return len(value) if isinstance(value, str) else 0


def read_rows(path: Path, columns: Sequence[str], added: Collection[str] = ()) -> Iterator[tuple[Any, ...]]:
    """The values of ``columns`` in each row of the file at ``path``, which lies in the folder of its table; times in s
    since 1970. Columns of ``added`` that the file lacks are None.

    The file's own list of contents tells the memory that it takes, before any row is read. Equal texts share memory.

    Raises:
        InvalidInputError: the file cannot be read or is too large, pyarrow is not installed, or a row does not belong
            to the table; the error names the row.
    """
    pyarrow, parquet = _load_pyarrow(str(path))
    try:
        with open_regular(path) as opened:
            about = parquet.read_metadata(opened, memory_map=False)
            lacking = {*added} - {*about.schema.to_arrow_schema().names}
            wanted = [name for name in columns if name not in lacking]
            _check_contents(pyarrow, path, about, wanted, opened)
            texts = [leaf.path for leaf in _leaves(about, wanted) if str(leaf.logical_type) == "String"]
            opened.seek(0)
            check = RowCheck(path, path.parent.name, columns)
            with parquet.ParquetFile(opened, metadata=about, read_dictionary=texts) as file:
                for batch in file.iter_batches(ROWS_AT_ONCE, columns=wanted):
                    unknown = [None] * batch.num_rows
                    values = [
                        unknown if name in lacking else _from_array(pyarrow, batch.column(name)) for name in columns
                    ]
                    rows = list(zip(*values, strict=True))
                    check.check(rows)
                    yield from rows
    except (OSError, KeyError, ValueError, MemoryError, pyarrow.ArrowException) as error:
        why = (str(error).splitlines() or [type(error).__name__])[0][:200]
        problem = f"is no table of a recording: {why}; move it elsewhere"
        raise InvalidInputError(str(path), [problem]) from None


def _leaves(about: Any, wanted: Collection[str]) -> list[Any]:
    """The Parquet columns of the columns ``wanted``; a column of lists may have several."""
    columns = (about.schema.column(k) for k in range(about.num_columns))
    return [column for column in columns if column.path.partition(".")[0] in wanted]


def _check_contents(pyarrow: Any, path: Path, about: Any, wanted: Collection[str], opened: BinaryIO) -> None:
    """Checks that the file has each of the columns ``wanted`` once and of its type, and that they fit into memory, by
    the file's list of contents and the headers of its pages.

    Raises:
        InvalidInputError: naming all problems.
        ValueError: the list of contents names pages that are not there.
    """
    found, table = about.schema.to_arrow_schema(), path.parent.name
    if table not in COLUMNS:
        raise InvalidInputError(str(path), [f"lies in no folder of a recording's tables: {', '.join(COLUMNS)}"])
    expected = _schema_of(pyarrow, table)
    problems = []
    for name in wanted:
        places = found.get_all_field_indices(name)
        if len(places) != 1:
            problems.append(f"column {name} is there {len(places)} times")
        elif (kind := found.field(places[0]).type) != (right := expected.field(name).type):
            problems.append(f"column {name} is of type {kind!s:.80}, not {right}")
    if about.num_rows > MOST_ROWS:
        cure = "record with --limit-gb, by which segments are shorter"
        problems.append(f"has {about.num_rows:,} rows, the limit is {MOST_ROWS:,}; {cure}")
    if not problems:
        problems += _find_large_groups(about, wanted, opened)
    if problems:
        raise InvalidInputError(str(path), [f"is no table of a recording that can be read: {'; '.join(problems)}"])


def _find_large_groups(about: Any, wanted: Collection[str], opened: BinaryIO) -> Iterator[str]:
    """Problem of the first row group that is too large; none where all fit.

    Raises:
        ValueError: the list of contents names pages that are not there.
    """
    leaves = {leaf.path for leaf in _leaves(about, wanted)}
    for k in range(about.num_row_groups):
        group = about.row_group(k)
        size = most = 0
        for chunk in map(group.column, range(group.num_columns)):
            if chunk.path_in_schema not in leaves:
                continue
            places = (chunk.data_page_offset, chunk.dictionary_page_offset if chunk.has_dictionary_page else 0)
            begin = min(filter(None, places), default=0)  # without rows there is a dictionary alone
            values = 0
            for page in read_pages(opened, begin, begin + chunk.total_compressed_size):
                size, values = size + page.size, values + page.values
                most = max(most, values)
                if size > LARGEST_GROUP:
                    yield f"row group {k + 1} has more than {LARGEST_GROUP:,} bytes when it is unpacked"
                    return
                if most > MOST_ROWS:
                    yield f"row group {k + 1} has more than {MOST_ROWS:,} values in a column"
                    return


def sync_path(path: Path) -> None:
    """Writes a file, or the entries of a folder, through to the disk."""
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
    types = pyarrow.types
    if types.is_timestamp(array.type):
        whole = array.cast(pyarrow.int64()).to_pylist()
        return [None if value is None else value / MICROSECONDS for value in whole]
    if types.is_dictionary(array.type):
        places = array.indices.to_pylist()
        used = sorted({place for place in places if place is not None})
        words = dict(zip(used, array.dictionary.take(pyarrow.array(used, pyarrow.int64())).to_pylist(), strict=True))
        return [None if place is None else words[place] for place in places]
    if types.is_list(array.type):
        items, ends = iter(_from_array(pyarrow, array.flatten())), array.value_lengths().to_pylist()
        return [None if length is None else list(itertools.islice(items, length)) for length in ends]
    return list(array.to_pylist())


def _load_pyarrow(what: str) -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        problem = f"pyarrow, which reads and writes Parquet, is not installed; {install_command('parquet')}"
        raise InvalidInputError(what, [problem]) from None
    return pyarrow, pyarrow.parquet
