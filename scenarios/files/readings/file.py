"""Readings files: readings of real meters as CSV with a unit in each column name; per unit and radians come out.

The header is ``meter``, of many scans ``scan``, and pairs ``value_UNIT,sigma_UNIT``; each row fills the one pair whose
unit it is in. A table of meters of a result, ``meters.csv``, is read as well.

docs/reference/scenario-files.md explains the format.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import read_text
from dsse_core.grid.columns import Records
from dsse_core.grid.measurement import Measurement, Meter
from dsse_core.grid.network import Network
from scenarios.files.readings.columns import SoundReadings, read_sound_columns
from scenarios.files.readings.rows import ReadingRows
from scenarios.files.readings.units import UNITS, WRITTEN_IN, unit_size
from scenarios.files.readings.written import as_readings_text

DATE = re.compile(r"\d{4}-\d\d-\d\d")
MOST_PLACES = 50_000_000  # 400 MB each of values and standard deviations


@dataclass(frozen=True)
class Scans:
    """Readings of many scans of one grid, p.u. and rad. ``names`` (n_scan,): their names in the file, by their times
    where all names state one, else in its order.

    ``meters``: all with a reading in any scan. ``values``, ``sigmas`` (n_scan, n_meas): nan where a scan lacks the
    reading.
    """

    names: tuple[str, ...]
    meters: Sequence[Meter]
    values: np.ndarray
    sigmas: np.ndarray

    @property
    def are_named(self) -> bool:
        """True where the file has a column ``scan``."""
        return self.names != ("",)

    @cached_property
    def times(self) -> np.ndarray:
        """Times of the scans, s since 1970, (n_scan,); nan where the name of a scan is no time."""
        return np.array([read_time(name) for name in self.names])


def read_time(text: str) -> float:
    """The time that ``text`` states by ISO 8601, with date; UTC without a zone. Nan where it states none."""
    if not DATE.match(text):
        return math.nan
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return math.nan
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def load_readings(path: Path, network: Network) -> Records[Measurement]:
    """Read a readings file; values and standard deviations in p.u. and rad, in the file's order.

    Raises:
        InvalidInputError: the file cannot be read, or every problem of its header, or else of its rows, with line
            numbers: unknown meters, meters given twice, wrong units, values that are no numbers.
    """
    return _read(read_text(path), str(path), network, takes_scans=False).readings


def load_scans(path: Path, network: Network) -> Scans:
    """Read a readings file that may have a column ``scan``; without it the whole file is one scan, "".

    Raises:
        InvalidInputError: as ``load_readings``; or there are more places for readings than MOST_PLACES.
    """
    return read_scans(read_text(path), str(path), network)


def read_scans(text: str, source: str, network: Network) -> Scans:
    """The scans in ``text``, as ``load_scans`` reads them from a file; ``source``: name of the text in errors."""
    read = _read(text, source, network, takes_scans=True)
    scan_row = {scan: k for k, scan in enumerate(_in_order(list(dict.fromkeys(read.scans)), source))}
    if (places := len(scan_row) * len(read.meters)) > MOST_PLACES:
        problem = f"{len(scan_row):,} scans of {len(read.meters):,} meters are {places:,} places for readings"
        raise InvalidInputError(source, [f"{problem}, the limit is {MOST_PLACES:,}; divide it into several files"])
    at = np.array([scan_row[scan] for scan in read.scans]), read.column
    values, sigmas = np.full((2, len(scan_row), len(read.meters)), np.nan)
    values[at], sigmas[at] = read.values, read.sigmas
    return Scans(tuple(scan_row), read.meters, values, sigmas)


def _in_order(names: Sequence[str], source: str) -> Sequence[str]:
    """Names of scans by their times; as given where one states none.

    Raises:
        InvalidInputError: scans of different names state the same time.
    """
    times = {name: time for name in names if not math.isnan(time := read_time(name))}
    first = {time: name for name, time in reversed(times.items())}
    if twice := [(first[time], name) for name, time in times.items() if first[time] != name]:
        problems = [
            f"scans {one!r:.80} and {other!r:.80} are at the same time; give each its own" for one, other in twice
        ]
        raise InvalidInputError(source, problems)
    return sorted(names, key=times.__getitem__) if len(times) == len(names) else names


def _read(text: str, source: str, network: Network, *, takes_scans: bool) -> SoundReadings:
    text = as_readings_text(text)
    if (sound := read_sound_columns(text, network, takes_scans=takes_scans)) is not None:
        return sound
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    table = ReadingRows(network, takes_scans)
    try:
        header = next(filter(None, rows), [])  # empty lines are none, before it as after it
        table.take_header(header, max(rows.line_num, 1) if header else 1)
        if not table.problems:
            for row in rows:
                table.take(row, rows.line_num)
    except csv.Error as error:
        table.problems.append(f"line {rows.line_num}: not valid CSV ({error})")
    if not table.problems and not table.readings:
        table.problems.append("there is no reading; give one row for each meter")
    if table.problems:
        raise InvalidInputError(source, table.problems)
    return SoundReadings.of(table.readings, table.scans)


def save_readings(path: Path, network: Network, readings: Sequence[Measurement]) -> None:
    """Write a readings file that ``load_readings`` reads back: p.u. for voltages, else MW, Mvar, degrees, ampere."""
    units = [unit for unit in UNITS if any(WRITTEN_IN[m.meter.kind.quantity] == unit for m in readings)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["meter", *(f"{column}_{unit}" for unit in units for column in ("value", "sigma"))])
        for m in readings:
            unit = WRITTEN_IN[m.meter.kind.quantity]
            size = unit_size(unit, m.meter, network)
            pair = [repr(float(m.value / size)), repr(float(m.sigma / size))]  # exact
            writer.writerow([m.meter.id, *(cell for u in units for cell in (pair if u == unit else ["", ""]))])
