"""Readings files: what real meters read, as CSV with a unit in each column name; per unit and radians come out.

The header is ``meter`` and pairs ``value_UNIT,sigma_UNIT``; each row fills the one pair whose unit it is in.
docs/reference/scenario-files.md explains the format.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import read_text
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.network import Network
from scenarios.files.reading_columns import read_sound_columns
from scenarios.files.reading_rows import ReadingRows
from scenarios.files.reading_units import UNITS, WRITTEN_IN, unit_size


def load_readings(path: Path, network: Network) -> tuple[Measurement, ...]:
    """Read a readings file; values and standard deviations in p.u. and rad, in the file's order.

    Raises:
        InvalidInputError: the file cannot be read, or every problem of its header, or else of its rows, with line
            numbers: unknown meters, meters given twice, wrong units, values that are no numbers.
    """
    text = read_text(path)
    if (sound := read_sound_columns(text, network)) is not None:
        return sound
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    table = ReadingRows(network)
    try:
        table.take_header(next(rows, []))
        if not table.problems:
            for row in rows:
                table.take(row, rows.line_num)
    except csv.Error as error:
        table.problems.append(f"line {rows.line_num}: not valid CSV ({error})")
    if not table.problems and not table.readings:
        table.problems.append("there is no reading; give one row for each meter")
    if table.problems:
        raise InvalidInputError(str(path), table.problems)
    return tuple(table.readings)


def save_readings(path: Path, network: Network, readings: Sequence[Measurement]) -> None:
    """Write a readings file that ``load_readings`` reads back: p.u. for voltages, else MW, Mvar, degrees, ampere."""
    units = [unit for unit in UNITS if any(WRITTEN_IN[m.meter.kind] == unit for m in readings)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["meter", *(f"{column}_{unit}" for unit in units for column in ("value", "sigma"))])
        for m in readings:
            unit = WRITTEN_IN[m.meter.kind]
            size = unit_size(unit, m.meter, network)
            pair = [repr(float(m.value / size)), repr(float(m.sigma / size))]  # exact
            writer.writerow([m.meter.id, *(cell for u in units for cell in (pair if u == unit else ["", ""]))])
