"""A readings file without a mistake, column by column: of a large grid it has half a million rows."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, find_meter_problems
from dsse_core.grid.meter_table import number_kinds
from dsse_core.grid.network import Network
from dsse_core.limits import LARGEST_SIGMA, SMALLEST_SIGMA
from scenarios.files.reading_rows import ReadingRows, parse_meter
from scenarios.files.reading_units import RANGES, UNITS

KIND = MeasurementKind


@dataclass(frozen=True)
class SoundReadings:
    """``readings`` in p.u. and rad, of each the scan; "" where the file has no such column."""

    readings: tuple[Measurement, ...]
    scans: Sequence[str]


def read_sound_columns(text: str, network: Network, *, takes_scans: bool = False) -> SoundReadings | None:
    """What ``ReadingRows`` reads; None where anything is unusual, which it then names or takes."""
    try:
        header, *rows = (row for row in csv.reader(io.StringIO(text, newline=""), strict=True) if row)
    except (csv.Error, ValueError):  # no header
        return None
    checked = ReadingRows(network, takes_scans)
    checked.take_header(header)
    if checked.problems or not rows or set(map(len, rows)) != {len(header)}:
        return None
    names, *cells = zip(*rows, strict=True)
    scans: Sequence[str] = cells.pop(0) if checked.takes_many else [""] * len(names)
    if checked.takes_many and not all(scan and scan == scan.strip() for scan in set(scans)):
        return None
    meter_of = {name: parse_meter(name) for name in dict.fromkeys(names)}
    known = [meter for meter in meter_of.values() if isinstance(meter, Meter)]
    if len(known) < len(meter_of) or any(True for _ in find_meter_problems(network, known)):
        return None
    if len(set(zip(scans, names, strict=True))) < len(names):
        return None
    meters = [meter for name in names if isinstance(meter := meter_of[name], Meter)]
    try:
        read = _read_cells(cells, checked.units, meters, network)
    except ValueError:
        return None
    if read is None:
        return None
    return SoundReadings(tuple(map(Measurement, meters, *(part.tolist() for part in read))), scans)


@np.errstate(over="ignore", invalid="ignore")  # a number that is too large is no sound one
def _read_cells(
    cells: Sequence[Sequence[str]], units: Sequence[str], meters: Sequence[Meter], network: Network
) -> tuple[np.ndarray, np.ndarray] | None:
    """Values and sigmas of all rows, (n,) each; None where some cannot be.

    Raises:
        ValueError: a cell is no number.
    """
    kind = number_kinds(meters)
    values, sigmas, times = np.zeros(len(meters)), np.zeros(len(meters)), np.zeros(len(meters), dtype=int)
    for k, unit in enumerate(units):
        filled = np.array([cell != "" for cell in cells[2 * k]])
        size = _sizes_of(unit, list(compress(meters, filled.tolist())), network)
        values[filled] = np.array([float(cell) for cell in cells[2 * k] if cell]) * size
        sigmas[filled] = np.array([float(cell) for cell in cells[2 * k + 1] if cell]) * size  # or ValueError: shapes
        if not (filled == np.array([cell != "" for cell in cells[2 * k + 1]])).all():
            return None
        if not np.array([one in UNITS[unit] for one in KIND])[kind[filled]].all():
            return None
        times += filled
    possible = (times == 1) & np.isfinite(values) & (sigmas >= SMALLEST_SIGMA) & (sigmas <= LARGEST_SIGMA)
    for k, one in enumerate(KIND):
        limits, size_of_one = RANGES[one]
        read = values[kind == k] * (network.base_mva if size_of_one is None else size_of_one)
        possible[kind == k] &= (limits.least <= read) & (read <= limits.most)
    return (values, sigmas) if possible.all() else None


def _sizes_of(unit: str, meters: Sequence[Meter], network: Network) -> np.ndarray | float:
    """``unit_size`` of all ``meters``."""
    match unit:
        case "mw" | "mvar":
            return 1 / network.base_mva
        case "deg":
            return math.radians(1)
        case "kv" | "a":
            base_kv = np.array([network.bus(meter.bus).base_kv for meter in meters])
            return 1 / base_kv if unit == "kv" else math.sqrt(3) * base_kv / network.base_mva / 1000
        case _:
            return 1.0
