"""Source ``csv``: a file that another program appends to, or replaces by a new one."""

from __future__ import annotations

import asyncio
import csv
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, BinaryIO, Literal

from pydantic import Field

from coordinator.field.gateway.interface import Emit, MapPath, Source
from coordinator.field.gateway.sources.lines import PIECE, TOO_LONG, LineCutter
from coordinator.field.gateway.sources.texts import as_number, as_time, as_validity
from dsse_core.files.bounded_file import open_regular
from dsse_core.files.strict_table import Table

MALFORMED, NO_VALUE = "malformed", "no value"
ADDRESS, VALUE, VALID, UNIT = "address", "value", "valid", "unit"


class CsvSettings(Table):
    """Keys of ``[source]``. ``time``: the column of the times of measurement."""

    path: MapPath
    delimiter: Literal[",", ";", "\t"] = ","
    time: str = "time"
    poll_s: Annotated[float, Field(ge=0.01, le=60.0)] = 0.2


class HeaderError(ValueError):
    """The first line names no columns that can be used."""


class CsvSource(Source):
    """Reads a file with a header: columns ``time``, ``address`` and ``value``, with or without ``valid`` and ``unit``;
    or ``time`` and a column for each address. An empty cell is no reading; a line without readings is rejected. A line
    counts once its line end has been read.
    """

    Settings = CsvSettings
    settings: CsvSettings

    async def read(self, emit: Emit) -> None:
        while True:
            with open_regular(self.settings.path) as file:
                await self._follow(file, emit)

    async def _follow(self, file: BinaryIO, emit: Emit) -> None:
        """Emit the lines of ``file`` until another file replaces it, or it becomes shorter."""
        cutter = LineCutter()
        columns: _Columns | None = None
        while True:
            is_replaced = not _is_same(file, self.settings.path)  # asked before the last read of a replaced file
            while piece := file.read(PIECE):
                for line in cutter.cut(piece):
                    if line is None:
                        emit.reject(MALFORMED, TOO_LONG)
                    elif columns is None and line.strip():
                        columns = _Columns(line, self.settings)
                    elif columns is not None and line.strip():
                        columns.take(line, emit)
                await asyncio.sleep(0)
            if is_replaced:
                return
            await asyncio.sleep(self.settings.poll_s)


def _is_same(file: BinaryIO, path: Path) -> bool:
    """True where ``path`` is still ``file`` and at least as long as the part read, or does not exist at the moment."""
    try:
        now = path.stat()
    except FileNotFoundError:
        return True
    return os.path.samestat(now, os.fstat(file.fileno())) and now.st_size >= file.tell()


class _Columns:
    """The columns of a file, from its header."""

    def __init__(self, header: str, settings: CsvSettings) -> None:
        self.delimiter = settings.delimiter
        self.names = _cells(header.removeprefix("\ufeff"), settings.delimiter)
        twice = [name for name, count in Counter(self.names).items() if count > 1]
        if twice:
            raise HeaderError(f"{settings.path}: column {twice[0]!r:.80} stands twice in the first line; keep one")
        if settings.time not in self.names:
            raise HeaderError(
                f"{settings.path}: the first line has no column {settings.time!r}, found {header[:200]!r}; a reading "
                "without a time may be of any age; add the column, or name it by source.time"
            )
        self.time = settings.time
        self.is_long = ADDRESS in self.names and VALUE in self.names

    def take(self, line: str, emit: Emit) -> None:
        try:
            cells = _cells(line, self.delimiter)
        except csv.Error as error:
            emit.reject(MALFORMED, f"line {line!r:.120}: {error}")
            return
        if len(cells) != len(self.names):
            emit.reject(MALFORMED, f"line {line!r:.120}: {len(cells)} columns, but the header has {len(self.names)}")
            return
        row = dict(zip(self.names, cells, strict=True))
        time = as_time(row.pop(self.time))
        read = {row[ADDRESS]: row[VALUE]} if self.is_long else row
        valid, unit = (as_validity(row.get(VALID)), row.get(UNIT) or None) if self.is_long else (True, None)
        if not any(read.values()):
            emit.reject(NO_VALUE, f"line {line!r:.120}: there is nothing where a value belongs")
        for address, value in read.items():
            if value:
                emit(address, as_number(value), time, valid=valid, unit=unit)


def _cells(line: str, delimiter: str) -> Sequence[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, strict=True), [])]
