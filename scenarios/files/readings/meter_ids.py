"""Reader of meter ids that takes all ids at once, letter by letter."""

from __future__ import annotations

import numpy as np

from dsse_core.grid.columns import Records, rows_of_texts
from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import KINDS, make_meters
from dsse_core.grid.network import Network
from scenarios.files.readings.rows import LONGEST_BUS

UNKNOWN = -1


def read_meter_ids(raw: bytes, start: np.ndarray, end: np.ndarray, network: Network) -> Records[Meter] | None:
    """The meters whose ids stand between ``start`` and ``end`` (n,) of ``raw``, UTF-8; None where a text is no id.

    Places that ``network`` does not have are not rejected here.
    """
    letters = np.frombuffer(raw, np.uint8)
    at = _find_first(letters, "@", start)
    if (at >= end).any():
        return None
    colon = np.minimum(_find_first(letters, ":", at), end)
    kind, bus = _read_kinds(letters, start, at), _read_numbers(letters, at + 1, colon)
    if (kind == UNKNOWN).any() or (bus == UNKNOWN).any():
        return None
    branches = [raw[a:b] or None for a, b in zip((colon + 1).tolist(), end.tolist(), strict=True)]
    return make_meters(network, kind, bus, rows_of_texts(map(str.encode, network.branch_ids), branches))


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


def _read_numbers(letters: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whole numbers between ``start`` and ``end`` (n,); UNKNOWN where a text is no number or too long for a bus."""
    length = end - start
    number = np.where((length > 0) & (length <= LONGEST_BUS), 0, UNKNOWN)
    for i in range(min(int(length.max()), LONGEST_BUS)):
        here = np.flatnonzero((length > i) & (number != UNKNOWN))
        digit = letters[start[here] + i].astype(np.int64) - ord("0")
        number[here] = np.where((digit >= 0) & (digit <= 9), 10 * number[here] + digit, UNKNOWN)
    return number
