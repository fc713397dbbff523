"""The recent past of every bus, branch, meter and area, in a bounded amount of memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsse_core.grid.nodes import PHASES
from dsse_core.results.columns import OF_ALL_PHASES
from dsse_core.results.table import ALL_PHASES

MOST_BYTES = 128 * 1024 * 1024  # of all series together
MOST_MOMENTS = 20_000
BYTES_OF_ID = 150  # an id and its place, roughly
KINDS_WITH_A_PAST = ("bus", "branch", "meter", "area")
BY_PHASE = ("bus", "branch")  # kinds whose ids are those of a thing and of one of its phases


@dataclass(frozen=True, slots=True)
class _Moment:
    """``place``: id -> column of ``values``, the same object for moments whose ids are the same."""

    time: float
    place: Mapping[Any, int]
    values: np.ndarray
    bytes: int


class Series:
    """The past of things of one kind: at each moment a value of each of ``columns`` for each id. Ids come and go."""

    def __init__(self, columns: Sequence[str], most_bytes: int) -> None:
        self.columns = tuple(columns)
        self.bytes = 0
        self._most_bytes = most_bytes
        self._ids: tuple[Any, ...] = ()
        self._place: Mapping[Any, int] = {}
        self._moments: deque[_Moment] = deque()

    def take(self, time: float, ids: Sequence[Any], columns: Mapping[str, np.ndarray]) -> None:
        """Adds a moment, and drops the oldest ones while there are too many; the newest one is always kept."""
        cost = 0
        if self._ids != (ids := tuple(ids)):
            self._ids, self._place = ids, {name: k for k, name in enumerate(ids)}
            cost = BYTES_OF_ID * len(ids)
        with np.errstate(over="ignore"):  # a hostile area may send values beyond float32
            values = np.array([columns[name] for name in self.columns], dtype=np.float32)
        moment = _Moment(time, self._place, values, cost + values.nbytes)
        self._moments.append(moment)
        self.bytes += moment.bytes
        while len(self._moments) > 1 and (self.bytes > self._most_bytes or len(self._moments) > MOST_MOMENTS):
            self._forget_oldest()

    def _forget_oldest(self) -> None:
        """Drops the oldest moment. The cost of its places goes to the next moment if that has the same places."""
        oldest, following = self._moments.popleft(), self._moments[0]
        self.bytes -= oldest.bytes
        if following.place is oldest.place:
            cost = oldest.bytes - oldest.values.nbytes
            self._moments[0] = _Moment(following.time, following.place, following.values, following.bytes + cost)
            self.bytes += cost

    def read(self, name: Any) -> dict[str, Any]:
        """Times and columns of the moments that have the id ``name``; empty lists if none has it."""
        there = [(moment, place) for moment in self._moments if (place := moment.place.get(name)) is not None]
        found = np.array([moment.values[:, place] for moment, place in there]).reshape(len(there), len(self.columns))
        columns = {name: found[:, k].astype(float).tolist() for k, name in enumerate(self.columns)}
        return {"time": [moment.time for moment, _ in there], "columns": columns}


class History:
    """The series of all kinds. ``has_phases``: of a known grid with phases, whose tables have ``OF_ALL_PHASES``."""

    def __init__(self, most_bytes: int = MOST_BYTES, *, has_phases: bool = False) -> None:
        share = most_bytes // len(KINDS_WITH_A_PAST)
        of_bus, of_branch = ([name] * has_phases for name in OF_ALL_PHASES)
        self.of = {
            "bus": Series(("vm_pu", "sigma_vm_pu", "va_deg", *of_bus), share),
            "branch": Series(("p_from_kw", "q_from_kvar", "i_from_a", "loading_percent", *of_branch), share),
            "meter": Series(("reading", "estimate", "normalised_residual"), share),
            "area": Series(("quality", "lowest_vm_pu", "highest_vm_pu", "messages", "lost"), share),
        }

    def read(self, kind: str, name: str) -> dict[str, Any]:
        """Times and columns of the thing ``name`` of ``kind``; the name of a bus is its number.

        With phases a column for each, such as ``vm_pu.a``, except those OF_ALL_PHASES.
        """
        series = self.of[kind]
        if kind not in BY_PHASE:
            return series.read(name)
        thing = int(name) if kind == "bus" else name
        balanced = series.read((thing, ALL_PHASES))
        of_phases = {phase: past for phase in PHASES[1:] if (past := series.read((thing, phase)))["time"]}
        return _join_phases(of_phases) if of_phases else balanced


def _join_phases(of_phases: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The past of each phase as one, nan at times at which a phase was not there."""
    times = sorted({at for past in of_phases.values() for at in past["time"]})
    columns = {}
    for phase, past in of_phases.items():
        for name, values in past["columns"].items():
            known = dict(zip(past["time"], values, strict=True))
            columns[name if name in OF_ALL_PHASES else f"{name}.{phase}"] = [known.get(at, np.nan) for at in times]
    return {"time": times, "columns": columns}
