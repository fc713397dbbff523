"""Column-by-column reader of a readings file without a mistake: that of a large grid has half a million rows.

Cells and meter ids are found all at once, by their positions and letter by letter.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dsse_core.grid.columns import Records, find_distinct, rows_of_texts
from dsse_core.grid.measurement import LONGEST_BUS, Measurement, Meter
from dsse_core.grid.meter_table import KINDS, each_fits, make_meters, number_meters, read_pair
from dsse_core.grid.network import Network
from dsse_core.grid.nodes import list_phases
from dsse_core.limits import LARGEST_SIGMA, SMALLEST_SIGMA
from scenarios.files.readings.rows import ReadingRows, find_leg_problems
from scenarios.files.readings.units import RANGES, UNITS, power_bases, sizes_of

UNKNOWN = -1
RANGES_OF_KINDS = [RANGES[kind.quantity] for kind in KINDS]


@dataclass(frozen=True)
class Cells:
    """Rows with a cell for each of ``titles``: begin and end of each cell in ``raw``, (n_row, n_column)."""

    titles: list[str]
    raw: bytes
    start: np.ndarray
    end: np.ndarray

    @cached_property
    def are_filled(self) -> np.ndarray:
        """True where a cell is not empty, (n_row, n_column)."""
        return np.asarray(self.end > self.start)

    @cached_property
    def filled(self) -> list[bytes]:
        """Contents of the cells that are not empty, row by row."""
        rows = self.raw[self.raw.index(b"\n") + 1 :]
        return list(filter(None, rows.replace(b",", b"\n").split(b"\n")))


def split_cells(text: str) -> Cells | None:
    """The cells of ``text``; None where they are not plain.

    Cells are plain where ``text`` is CSV, all rows have the length of the first, and no cell contains a comma or a line
    end.
    """
    text = text if '"' in text else text.replace("\r\n", "\n").removesuffix("\n")
    if '"' in text or "\r" in text or "\n\n" in f"\n{text}":  # quoted cells, other line ends, empty lines
        if (plain := _write_plain(text)) is None:
            return None
        text = plain
    raw = f"{text}\n".encode()
    titles = text.partition("\n")[0].split(",")
    letters = np.frombuffer(raw, np.uint8)
    end = np.flatnonzero((letters == ord(",")) | (letters == ord("\n")))
    if len(end) % len(titles):
        return None
    ends_line = (letters[end] == ord("\n")).reshape(-1, len(titles))
    if ends_line[:, :-1].any() or not ends_line[:, -1].all():
        return None
    start = np.append(0, end[:-1] + 1)
    return Cells(titles, raw, start.reshape(ends_line.shape)[1:], end.reshape(ends_line.shape)[1:])


def _write_plain(text: str) -> str | None:
    """The same table without quotes and empty lines; None where it is not plain."""
    try:
        rows = [row for row in csv.reader(io.StringIO(text, newline=""), strict=True) if row]
    except csv.Error:
        return None
    lines = list(map(",".join, rows))
    plain, lengths = "\n".join(lines), set(map(len, rows))
    is_plain = len(lengths) == 1 and plain.count(",") == len(rows) * (lengths.pop() - 1)
    return plain if is_plain and plain.count("\n") == len(rows) - 1 and "\r" not in plain else None


def read_meter_ids(raw: bytes, start: np.ndarray, end: np.ndarray, network: Network) -> Records[Meter] | None:
    """The meters whose ids stand between ``start`` and ``end`` (n,) of ``raw``, UTF-8; None where a text is no id.

    Places that ``network`` does not have are not rejected here.
    """
    letters = np.frombuffer(raw, np.uint8)
    at = _find_first(letters, "@", start)
    if (at >= end).any():
        return None
    colon = np.minimum(_find_first(letters, ":", at), end)
    point = np.minimum(_find_first(letters, ".", at), colon)
    kind, bus = _read_kinds(letters, start, at), _read_buses(letters, at + 1, point)
    if (kind == UNKNOWN).any() or (bus == UNKNOWN).any():
        return None
    phases = None
    if (point < colon).any() and (phases := _read_phases(raw, point, colon, network)) is None:
        return None
    branches = [raw[a:b] or None for a, b in zip((colon + 1).tolist(), end.tolist(), strict=True)]
    branch = rows_of_texts(map(str.encode, network.branch_ids), branches)
    return make_meters(network, kind, bus, branch, phases=phases)


def _read_phases(raw: bytes, start: np.ndarray, end: np.ndarray, network: Network) -> np.ndarray | None:
    """The phases of meters whose texts, such as ".ab" or nothing, stand between ``start`` and ``end`` (n,) of ``raw``.

    (2, n), as in ``MeterTable``. None where a text is none, and where the network has no phases.
    """
    texts = [raw[a:b] for a, b in zip(start.tolist(), end.tolist(), strict=True)]
    numbers = {text: read_pair(text[1:].decode()) for text in set(texts)}
    if network.table.nodes.is_balanced or b"." in numbers or None in numbers.values():
        return None
    return np.array([numbers[text] for text in texts], dtype=np.int64).T


def _find_first(letters: np.ndarray, wanted: str, start: np.ndarray) -> np.ndarray:
    """The place of the first letter ``wanted`` from each ``start`` (n,) on; past the end where there is none."""
    places = np.append(np.flatnonzero(letters == ord(wanted)), len(letters))
    found: np.ndarray = places[np.searchsorted(places, start)]
    return found


def _read_kinds(letters: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The positions in KINDS of the names between ``start`` and ``end`` (n,); UNKNOWN where a name is no kind."""
    kind = np.full(len(start), UNKNOWN)
    for k, name in enumerate(KINDS):
        alike = np.flatnonzero(end - start == len(name))
        for i, letter in enumerate(name):
            alike = alike[letters[start[alike] + i] == ord(letter)]
        kind[alike] = k
    return kind


def _read_buses(letters: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whole numbers between ``start`` and ``end`` (n,); UNKNOWN where a text is no number or too long for a bus."""
    length = end - start
    number = np.where((length > 0) & (length <= LONGEST_BUS), 0, UNKNOWN)
    for i in range(min(int(length.max()), LONGEST_BUS)):
        here = np.flatnonzero((length > i) & (number != UNKNOWN))
        digit = letters[start[here] + i].astype(np.int64) - ord("0")
        number[here] = np.where((digit >= 0) & (digit <= 9), 10 * number[here] + digit, UNKNOWN)
    return number


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
        """All readings, of a file of one scan."""
        return Records(Measurement, {"meter": self.meters, "value": self.values, "sigma": self.sigmas})


def read_sound_columns(text: str, network: Network, *, takes_scans: bool = False) -> SoundReadings | None:
    """The readings of ``text`` as ``ReadingRows`` reads them; None where anything is unusual.

    ``ReadingRows`` then reads the unusual text, or names its problems.
    """
    if (cells := split_cells(text)) is None:
        return None
    checked = ReadingRows(network, takes_scans)
    checked.take_header(cells.titles)
    if checked.problems or not len(cells.start):
        return None
    first = len(checked.keys)
    unit = _find_units(cells.are_filled[:, first:])
    if unit is None or not cells.are_filled[:, :first].all():
        return None
    of_rows = read_meter_ids(cells.raw, cells.start[:, 0], cells.end[:, 0], network)
    if of_rows is None or not each_fits(network, of_rows):
        return None
    scans = _read_scans(cells.filled[1 :: first + 2]) if checked.takes_many else [""] * len(of_rows)
    first_rows, column = find_distinct(number_meters(network, of_rows))
    if _have_doubtful_pairs(checked, of_rows.take(first_rows)):
        return None
    if scans is None or _have_doubles(scans if checked.takes_many else None, column):
        return None
    try:
        values, sigmas = (_read_numbers(cells.filled[k :: first + 2]) for k in (first, first + 1))
    except ValueError:
        return None
    sizes = _find_sizes(checked.units, unit, of_rows, network)
    if sizes is None or not _are_possible(of_rows, values * sizes, sigmas * sizes, network):
        return None
    return SoundReadings(of_rows.take(first_rows), column, values * sizes, sigmas * sizes, scans)


def _have_doubtful_pairs(checked: ReadingRows, meters: Records[Meter]) -> bool:
    """True where a distinct meter between two phases reads what another one reads, or no power that is there."""
    if checked.network.table.nodes.is_balanced:
        return False
    between = [meter for meter in meters if len(list_phases(meter.phases)) == 2]
    is_twice = len({meter.quantity for meter in between}) < len(between)
    return is_twice or any(find_leg_problems(checked.injections, between))


def _find_units(are_filled: np.ndarray) -> np.ndarray | None:
    """The pair of columns of ``are_filled`` (n, 2 n_unit) with value and sigma of each row, (n,).

    None where a row does not fill exactly one pair.
    """
    of_value, of_sigma = are_filled[:, ::2], are_filled[:, 1::2]
    is_sound = (of_value == of_sigma).all() and (of_value.sum(axis=1) == 1).all()
    return of_value.argmax(axis=1) if is_sound else None


def _read_scans(cells: Sequence[bytes]) -> Sequence[str] | None:
    """The scan of each row; None where the name of a scan has blanks around it."""
    names = {cell: cell.decode() for cell in set(cells)}
    return [names[cell] for cell in cells] if all(name == name.strip() for name in names.values()) else None


def _have_doubles(scans: Sequence[str] | None, column: np.ndarray) -> bool:
    """True where a scan has a meter twice. ``column`` (n,): meter of each row; ``scans``: None for a single scan."""
    place = column
    if scans is not None:
        row = {scan: k for k, scan in enumerate(dict.fromkeys(scans))}
        place = np.fromiter(map(row.__getitem__, scans), np.int64, len(scans)) * len(column) + column
    return len(find_distinct(place)[0]) < len(place)


def _read_numbers(cells: Sequence[bytes]) -> np.ndarray:
    """The numbers in ``cells``, (n,).

    Raises:
        ValueError: a cell is no number.
    """
    return np.array(list(map(float, cells)))


def _find_sizes(units: Sequence[str], unit: np.ndarray, meters: Records[Meter], network: Network) -> np.ndarray | None:
    """Size of the ``unit`` of each of ``meters`` in p.u. or rad, (n,); None where a meter cannot be in its unit."""
    kind = meters.columns["kind"]
    if not np.array([[kind.quantity in UNITS[name] for kind in KINDS] for name in units])[unit, kind].all():
        return None
    sizes = np.empty(len(unit))
    for k, name in enumerate(units):
        here = np.flatnonzero(unit == k)
        sizes[here] = sizes_of(name, meters.take(here), network)
    return sizes


@np.errstate(over="ignore", invalid="ignore")  # numbers that are too large are not sound
def _are_possible(meters: Records[Meter], values: np.ndarray, sigmas: np.ndarray, network: Network) -> bool:
    """True where ``ReadingRows`` takes all values and sigmas, p.u. and rad, of ``meters``, (n,) each."""
    if not (np.isfinite(values).all() and (sigmas >= SMALLEST_SIGMA).all() and (sigmas <= LARGEST_SIGMA).all()):
        return False
    kind = meters.columns["kind"]
    sizes = np.array([math.nan if size is None else size for _, size in RANGES_OF_KINDS])[kind]
    sizes = np.where(np.isnan(sizes), power_bases(meters, network), sizes)
    least, most = np.array([(limits.least, limits.most) for limits, _ in RANGES_OF_KINDS]).T
    read = values * sizes
    return bool(((least[kind] <= read) & (read <= most[kind])).all())
