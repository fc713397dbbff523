"""A table of meters of a result, ``meters.csv``, as the text of a readings file."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import fields

from dsse_core.grid.measurement import Source
from dsse_core.results.columns import MeterColumns

COLUMNS = frozenset(field.name for field in fields(MeterColumns))
METER, SCAN, TIME, SOURCE = "meter", "scan", "time", "source"


def as_readings_text(text: str) -> str:
    """The readings in ``text`` if that is a table of meters, else ``text`` itself.

    Rows without a reading, and those of virtual meters, become empty lines, so that lines keep their numbers. A scan
    is named by its time where that is known, and no other scan has it. The scan of a table of a single one has no name.
    """
    titles = text.partition("\n")[0].rstrip("\r").split(",")
    is_table = {METER, SOURCE} <= {*titles} <= COLUMNS and len({*titles}) == len(titles)
    if not is_table:
        return text
    try:
        _, *rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    except csv.Error:
        return text
    if any(len(row) not in (0, len(titles)) for row in rows):
        return text
    values = [k for k, title in enumerate(titles) if title.startswith("value_")]
    is_reading = _reading_of(titles, values)
    kept = [row if row and is_reading(row) else [] for row in rows]
    pairs = [
        (k, titles.index(sigma))
        for k in values
        if any(row[k] for row in kept if row) and (sigma := titles[k].replace("value", "sigma", 1)) in titles
    ]
    names = _name_scans(titles, kept)
    head = [METER, *([SCAN] if names else []), *(titles[k] for pair in pairs for k in pair)]
    meter = titles.index(METER)
    lines = io.StringIO(newline="")
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(head)
    for number, row in enumerate(kept):
        cells = [row[meter], *names[number : number + 1], *(row[k] for pair in pairs for k in pair)] if row else []
        writer.writerow(cells)
    return lines.getvalue()


def _reading_of(titles: Sequence[str], values: Sequence[int]) -> Callable[[Sequence[str]], bool]:
    """Function that is true for a row with the reading of a meter that is not virtual."""
    source = titles.index(SOURCE)
    return lambda row: row[source] != Source.VIRTUAL and any(row[k] for k in values)


def _name_scans(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Name of the scan of each row; none at all where the table has a single scan."""
    by = [titles.index(title) for title in (TIME, SCAN) if title in titles]
    found = dict.fromkeys(tuple(row[k] for k in by) for row in rows if row)
    of_time = Counter(cells[0] for cells in found if cells)
    name_of = {cells: next((x for x in cells if x and of_time[x] < 2), cells[-1] if cells else "") for cells in found}
    names = [name_of[tuple(row[k] for k in by)] if row else "" for row in rows]
    return names if len({name for name, row in zip(names, rows, strict=True) if row}) > 1 else []
