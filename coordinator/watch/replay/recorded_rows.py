"""Rows of a recording, from its log or from its files, and notes on its lost parts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

from coordinator.watch.recording.closing import rows_of_log
from coordinator.watch.recording.folder import log_of, table_of
from coordinator.watch.recording.parquet import read_rows
from coordinator.watch.recording.recorded_tables import ADDED, COLUMNS, Row
from dsse_core.errors import LONGEST_LINE
from dsse_core.printable import on_one_line, printable, shortened_inside

MOST_NOTES = 50
LOST = ("damaged log", "unreadable", "lost")  # events


def note(notes: list[str], text: str) -> None:
    """Adds ``text`` to ``notes`` on the lost parts of a recording, up to ``MOST_NOTES``; then a last note on more."""
    if len(notes) < MOST_NOTES:
        notes.append(shortened_inside(printable(on_one_line(text)), LONGEST_LINE))
    elif len(notes) == MOST_NOTES:
        notes.append("and more of this kind")


def rows_of_segment(folder: Path, segment: str, needed: Mapping[str, Sequence[str]]) -> Iterator[Row]:
    """The rows of ``segment`` in the tables of ``needed`` (table -> columns to read), with these columns.

    The rows come from the log, in order, if it still exists because closing has not ended; else from the files, table
    by table. Details of events on lost parts begin with the file.

    Raises:
        InvalidInputError: a file cannot be read, or is not part of a recording.
    """
    if (log := log_of(folder, segment)).exists():
        pick = {
            table: itemgetter(*(list(COLUMNS[table]).index(name) for name in names)) for table, names in needed.items()
        }
        for table, row in rows_of_log(folder, segment):
            if table in needed:
                picked = pick[table](row)
                yield table, _name_file(log, needed[table], picked) if table == "events" else picked
        return
    for table, columns in needed.items():
        if (path := table_of(folder, table, segment)).exists():
            for row in read_rows(path, columns, ADDED.get(table, ())):
                yield table, _name_file(path, columns, row) if table == "events" else row


def _name_file(path: Path, columns: Sequence[str], row: tuple[Any, ...]) -> tuple[Any, ...]:
    """The ``row`` of an event, with the file in its details if the event is about a lost part."""
    event, details = columns.index("event"), columns.index("details")
    if row[event] not in LOST:
        return row
    return (*row[:details], f"{path}: {row[event]}: {row[details]}", *row[details + 1 :])
