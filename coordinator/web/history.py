"""The recent past of every bus, branch, meter and area, in a bounded amount of memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

MOST_BYTES = 64 * 1024 * 1024  # of all series together
MOST_MOMENTS = 20_000
KINDS = ("bus", "branch", "meter", "area")


class Series:
    """One kind of thing: at each moment an array for each of ``columns``, a place for each of ``ids``."""

    def __init__(self, columns: Sequence[str], most_bytes: int) -> None:
        self.columns = tuple(columns)
        self._most_bytes = most_bytes
        self._ids: tuple[Any, ...] = ()
        self._place: dict[Any, int] = {}
        self._moments: deque[tuple[float, np.ndarray]] = deque(maxlen=MOST_MOMENTS)

    @property
    def bytes(self) -> int:
        """How much memory the numbers take."""
        return sum(values.nbytes for _, values in self._moments)

    def take(self, time: float, ids: Sequence[Any], columns: Mapping[str, np.ndarray]) -> None:
        """Keep a moment, and forget the oldest ones where that is too much; other ``ids`` begin anew."""
        if self._ids != (ids := tuple(ids)):
            self._ids, self._place = ids, {name: k for k, name in enumerate(ids)}
            self._moments.clear()
        values = np.array([columns[name] for name in self.columns], dtype=np.float32)
        most = max(2, self._most_bytes // max(1, values.nbytes))
        while len(self._moments) >= min(most, MOST_MOMENTS):
            self._moments.popleft()
        self._moments.append((time, values))

    def read(self, name: Any) -> dict[str, Any]:
        """Times, and each column, of one of the ids; empty if it is not known."""
        place = self._place.get(name)
        moments = list(self._moments) if place is not None else []
        found = np.array([values[:, place] for _, values in moments]).reshape(len(moments), len(self.columns))
        columns = {name: found[:, k].astype(float).tolist() for k, name in enumerate(self.columns)}
        return {"time": [time for time, _ in moments], "columns": columns}


class History:
    """The series of all kinds."""

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        share = most_bytes // len(KINDS)
        self.of = {
            "bus": Series(("vm_pu", "sigma_vm_pu", "va_deg"), share),
            "branch": Series(("p_from_kw", "q_from_kvar", "i_from_a", "loading_percent"), share),
            "meter": Series(("reading", "estimate", "normalised_residual"), share),
            "area": Series(("quality", "lowest_vm_pu", "highest_vm_pu", "messages", "lost"), share),
        }
