"""Numbers that only tell what they rest on, in the place of ``AreaEstimation``.

Information is the list of (area, term, k) behind it. Whoever takes a step sees whether every area is in it once, in the
same term and round.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from unittest import mock

import numpy as np

from dsse_core.estimation.decision import Decision, Totals
from dsse_core.estimation.switches import Gain
from dsse_core.grid.partition import Area
from dsse_core.linear.boundary_information import BoundaryInformation

Part = tuple[str, tuple[int, int], int]  # area, term, k


class ToyEstimation:
    """What ``AreaEstimation`` is to ``AreaRound``; every iteration takes two rounds, the second step is 0."""

    sent: list[tuple[Part, ...]] = []  # noqa: RUF012 - what every information that was passed on rests on, by number

    def __init__(self, area: Area) -> None:
        self.area = area
        self.failure = ""
        self.removed = self.critical = self.dead_voltmeters = self.into_children = ()
        self.reported: set[str] = set()
        self.gains: dict[str, Gain] = {}
        self.taps: dict[str, tuple[float, float]] = {}
        self.before_removal = None
        self.is_first = False
        self.dead, self.dead_places = np.zeros(1, dtype=bool), ()
        self.find_term: Callable[[], tuple[int, int]] = lambda: (0, 0)
        self.final: tuple[Part, ...] = ()
        self.reading = float("nan")
        self._silent: tuple[str, ...] = ()
        self._is_stale = False
        self._term, self._k, self._step = (0, 0), 0, 0.0

    def begin(self, readings: Sequence, *, silent: set[str], stale: bool, loads: Mapping, closed: Mapping) -> None:
        self._silent, self._is_stale, self.failure = tuple(sorted(silent)), stale, ""
        self._term, self._k, self._step, self.final = self.find_term(), 0, 0.0, ()
        self.reading = next((m.value for m in readings), float("nan"))

    def fail(self, error: BaseException) -> None:
        raise AssertionError("the toy has failed") from error

    def set_power(self, neighbour: str, power: Sequence[float]) -> None:
        pass

    def power_for(self, neighbour: str) -> tuple[float, ...]:
        return ()

    def pieces_for(self, neighbour: str, received: Mapping) -> tuple[int, ...]:
        return ()

    def no_load_for(self, neighbour: str, received: Mapping) -> None:
        return None

    def boundary_values(self, neighbour: str) -> tuple[float, ...]:
        return 0.0, 0.0, 1.0, 0.0

    def information_for(self, neighbour: str, received: Mapping[str, BoundaryInformation]) -> BoundaryInformation:
        self.sent.append(self._with(received))
        R = np.zeros((4, 4))
        R[0, 0] = len(self.sent) - 1
        return BoundaryInformation(R, np.zeros(4))

    def _with(self, received: Mapping[str, BoundaryInformation]) -> tuple[Part, ...]:
        """The own part and those behind ``received``; each area once, all of this term and round."""
        parts = [(self.area.name, self._term, self._k)]
        for information in received.values():
            parts += self.sent[int(information.R[0, 0])]
        assert len({name for name, _, _ in parts}) == len(parts), f"an area counts twice in {parts}"
        assert {(term, k) for _, term, k in parts} == {(self._term, self._k)}, f"of other rounds: {parts}"
        return tuple(parts)

    def prepare(self) -> None:
        """There is nothing to do ahead."""

    def totals(self) -> Totals:
        stale = (self.area.name,) if self._is_stale else ()
        return Totals(dvm=self._step, degrees_of_freedom=9, areas=1, referenced=True, silent=self._silent, stale=stale)

    def carry_out(self, verdict, memory, received: Mapping[str, BoundaryInformation], no_load: Mapping, pieces) -> None:
        assert verdict.takes_step
        parts = self._with(received)
        if verdict.decision is Decision.FINAL:
            self.final = parts
        self._k += 1

    def find_sigmas(self) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
        return np.ones(1), np.ones(1), ()

    def owns(self, suspect: str) -> bool:
        return False

    def weigh_switches(self) -> None:
        pass

    def describe_readings(self) -> dict[str, tuple[float, float]]:
        return {}

    @property
    def no_load_va(self) -> np.ndarray:
        return np.zeros(1)

    @property
    def voltages(self) -> tuple[np.ndarray, np.ndarray]:
        return np.ones(1), np.zeros(1)


@contextmanager
def toy_numbers() -> Iterator[None]:
    """Areas begun meanwhile have the numbers of the toy."""
    ToyEstimation.sent = []
    with mock.patch("agents.protocol.rounds.area_round.AreaEstimation", ToyEstimation):
        yield
