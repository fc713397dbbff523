"""Places of meters in a scenario file: a bus or a branch, each phase of it, some phases, or their total."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsse_core.grid.meter_table import UNKNOWN, read_pair
from dsse_core.grid.nodes import PHASES, PhaseRows, list_phases, write_phases

EACH, TOTAL = "", "total"
Place = int | str


@dataclass(frozen=True)
class Spots:
    """Spots at which meters stand, (n,) each: ``row`` of the bus or branch; ``phases`` (2, n), as in ``MeterTable``."""

    row: np.ndarray
    phases: np.ndarray

    def keep(self, kept: np.ndarray) -> Spots:
        """The spots at the positions ``kept``, or where it is true."""
        return Spots(self.row[kept], self.phases[:, kept])


def join_spots(parts: Sequence[Spots]) -> Spots:
    """The spots of all ``parts``, one after the other."""
    parts = [part for part in parts if len(part.row)] or parts[:1]
    if len(parts) == 1:
        return parts[0]
    return Spots(np.concatenate([part.row for part in parts]), np.concatenate([part.phases for part in parts], axis=1))


def make_totals(row: np.ndarray) -> Spots:
    """A spot for all phases of each bus or branch in ``row`` (n,) together."""
    return Spots(row, np.stack([np.full(len(row), PHASES.index("")), np.full(len(row), UNKNOWN)]))


@dataclass(frozen=True)
class Sites:
    """Buses, or branches, of a network at which meters stand; flows are metered at the from side.

    ``row_of``: id of each that is in service -> its row among these. ``rows``: their phases, those of branches first of
    the from ends. ``word``, ``key``: the name of one, and of the key that lists them.
    """

    word: str
    row_of: Mapping[Any, int]
    rows: PhaseRows

    @property
    def key(self) -> str:
        return {"bus": "buses", "branch": "branches"}[self.word]

    def read(self, place: Place) -> tuple[Place, str]:
        """The bus or branch of ``place``, and its phases: EACH, TOTAL, or one or two of them."""
        if place in self.row_of or not isinstance(place, str):
            return place, EACH
        site, _, phases = place.rpartition(".")
        if self.word == "bus":
            return int(site), phases
        return (site, phases) if phases and site in self.row_of else (place, EACH)

    def find(self, listed: Sequence[Place] | None) -> Spots:
        """The spots of the places that are there, each place once; of all sites where ``listed`` is None.

        First come those of whole sites.
        """
        return join_spots([self.spots_of(self.rows.of(self.list_whole(listed))), self.find_named(listed)])

    def list_whole(self, listed: Sequence[Place] | None) -> np.ndarray:
        """The rows of the sites that are listed as such, (n,); of all sites where ``listed`` is None."""
        if listed is None:
            return np.arange(len(self.row_of))
        known = (self.row_of[place] for place in dict.fromkeys(listed) if place in self.row_of)
        return np.fromiter(known, dtype=np.intp)

    def find_named(self, listed: Sequence[Place] | None) -> Spots:
        """The spots of the places that are listed with their phases."""
        named = [self._find_spot(place) for place in dict.fromkeys(listed or ()) if place not in self.row_of]
        spots: np.ndarray = np.array([spot for spot in named if spot], dtype=np.int64).reshape(-1, 3).T
        return Spots(spots[0], spots[1:])

    def _find_spot(self, place: Place) -> tuple[int, int, int] | None:
        """Row and phases of the spot of a ``place``; None where it is not there."""
        site, phases = self.read(place)
        if site not in self.row_of or self.find_problem_of_phases(place, 2, has_total=True):
            return None
        pair = read_pair("" if phases == TOTAL else phases)
        return (self.row_of[site], *pair) if pair else None

    def find_pairs(self, rows: np.ndarray) -> Spots:
        """The spots between each phase and the next at the buses in ``rows``, of two phases one."""
        pairs = []
        for row in rows.tolist():
            phases = self.rows.phase[self.rows.at(row)].tolist()
            following = phases[1:] + (phases[:1] if len(phases) > 2 else [])
            pairs += [(row, one, other) for one, other in zip(phases, following, strict=False)]
        spots: np.ndarray = np.array(pairs, dtype=np.int64).reshape(-1, 3).T
        return Spots(spots[0], spots[1:])

    def spots_of(self, rows: np.ndarray) -> Spots:
        """The spots at nodes or ports ``rows``."""
        phase = self.rows.phase[rows]
        return Spots(self.rows.item[rows], np.stack([phase, np.full(len(rows), UNKNOWN)]))

    def phases_at(self, site: Place) -> list[str]:
        """The phases that a site has; [""] in a balanced network."""
        return list(list_phases(write_phases(int(self.rows.sets[self.row_of[site]]))))

    def find_problem_of_phases(self, place: Place, most: int, *, has_total: bool) -> str:
        """The problem of the phases of ``place``, whose site is there, as text; empty without.

        ``most``: how many phases a meter takes."""
        site, phases = self.read(place)
        wanted, there = list_phases(phases), self.phases_at(site)
        if phases == EACH or (phases == TOTAL and has_total and there != [""]):
            return ""
        if there == [""]:
            return f"{place!r}: {self.word} {site} has no phases; leave out {'.' + phases!r}"
        if missing := [phase for phase in wanted if phase not in there]:
            return f"{place!r}: {self.word} {site} has no phase {', '.join(missing)}, only {', '.join(there)}"
        if not 0 < len(wanted) <= most or len(set(wanted)) < len(wanted):
            pair = "" if most == 1 else ", or two"
            total = f", or {TOTAL!r}" if has_total else ""
            return f"{place!r}: after the point name one phase{pair} of {', '.join(there)}{total}"
        return ""
