"""A readings file without a mistake, column by column: of a large grid it has half a million rows."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from dsse_core.grid.columns import Records, rows_of_texts
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter
from dsse_core.grid.meter_table import all_fit, make_meters
from dsse_core.grid.network import Network
from dsse_core.limits import LARGEST_SIGMA, SMALLEST_SIGMA
from scenarios.files.readings.rows import LONGEST_BUS, ReadingRows
from scenarios.files.readings.units import RANGES, UNITS

KIND = MeasurementKind
_CODE_OF_NAME = {str(kind): k for k, kind in enumerate(KIND)}


@dataclass(frozen=True)
class SoundReadings:
    """``meters``: all that have a reading, in the file's order. Of each reading, (n,): the position ``column`` of its
    meter, ``values`` and ``sigmas`` in p.u. and rad, and the scan; "" where the file has no such column.
    """

    meters: Sequence[Meter]
    column: np.ndarray
    values: np.ndarray
    sigmas: np.ndarray
    scans: Sequence[str]

    @classmethod
    def of(cls, readings: Sequence[Measurement], scans: Sequence[str]) -> SoundReadings:
        place = {meter: k for k, meter in enumerate(dict.fromkeys(m.meter for m in readings))}
        column = np.array([place[m.meter] for m in readings], dtype=np.intp)
        values, sigmas = (np.array([getattr(m, name) for m in readings]) for name in ("value", "sigma"))
        return cls(tuple(place), column, values, sigmas, scans)

    @property
    def readings(self) -> Records[Measurement]:
        """All, of one scan."""
        return Records(Measurement, {"meter": self.meters, "value": self.values, "sigma": self.sigmas})


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
    place = {name: k for k, name in enumerate(dict.fromkeys(names))}
    meters = _read_meters(list(place), network)
    if meters is None:
        return None
    if len(place) < len(names) and len(set(zip(scans, names, strict=True))) < len(names):
        return None
    column = np.array([place[name] for name in names], dtype=np.intp)
    try:
        read = _read_cells(cells, checked.units, meters.take(column), network)
    except ValueError:
        return None
    return None if read is None else SoundReadings(meters, column, *read, scans)


def _read_meters(names: Sequence[str], network: Network) -> Records[Meter] | None:
    """The meters with these ids; None where one is no id, does not fit the network, or is another spelling of one."""
    kinds, _, places = zip(*(name.partition("@") for name in names), strict=True)
    buses, _, branches = zip(*(place.partition(":") for place in places), strict=True)
    if not (
        all(map(str.isdecimal, buses)) and max(map(len, buses)) <= LONGEST_BUS and _CODE_OF_NAME.keys() >= {*kinds}
    ):
        return None
    kind = np.array([_CODE_OF_NAME[name] for name in kinds], dtype=np.int64)
    bus = np.array(list(map(int, buses)), dtype=np.int64)
    branch = rows_of_texts(network.branch_ids, [branch or None for branch in branches])
    return make_meters(network, kind, bus, branch) if all_fit(network, kind, bus, branch) else None


@np.errstate(over="ignore", invalid="ignore")  # a number that is too large is no sound one
def _read_cells(
    cells: Sequence[Sequence[str]], units: Sequence[str], meters: Records[Meter], network: Network
) -> tuple[np.ndarray, np.ndarray] | None:
    """Values and sigmas of all rows, (n,) each; None where some cannot be. ``meters``: of all rows.

    Raises:
        ValueError: a cell is no number.
    """
    kind, base_kv = meters.columns["kind"], network.table.base_kv[network.table.rows.find(meters.columns["bus"])]
    values, sigmas, times = np.zeros(len(meters)), np.zeros(len(meters)), np.zeros(len(meters), dtype=int)
    for k, unit in enumerate(units):
        given = list(map(bool, cells[2 * k]))
        if given != list(map(bool, cells[2 * k + 1])):
            return None
        filled = np.array(given)
        size = _sizes_of(unit, base_kv[filled], network.base_mva)
        values[filled] = np.array(list(map(float, compress(cells[2 * k], given)))) * size
        sigmas[filled] = np.array(list(map(float, compress(cells[2 * k + 1], given)))) * size
        if not np.array([one in UNITS[unit] for one in KIND])[kind[filled]].all():
            return None
        times += filled
    possible = (times == 1) & np.isfinite(values) & (sigmas >= SMALLEST_SIGMA) & (sigmas <= LARGEST_SIGMA)
    for k, one in enumerate(KIND):
        limits, size_of_one = RANGES[one]
        read = values[kind == k] * (network.base_mva if size_of_one is None else size_of_one)
        possible[kind == k] &= (limits.least <= read) & (read <= limits.most)
    return (values, sigmas) if possible.all() else None


def _sizes_of(unit: str, base_kv: np.ndarray, base_mva: float) -> np.ndarray | float:
    """``unit_size`` of meters at buses of these base voltages."""
    match unit:
        case "mw" | "mvar":
            return 1 / base_mva
        case "deg":
            return math.radians(1)
        case "kv":
            return 1 / base_kv
        case "a":
            return math.sqrt(3) * base_kv / base_mva / 1000
        case _:
            return 1.0
