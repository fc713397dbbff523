"""The numbers of one area in a term of rounds: received in round k, passed on, and used for the step.

Up(k) carries the information of the area's side at x_k towards the hub. Down(k) brings back the information of all
other areas, with the totals of all areas. Every area finds the verdict on these totals for itself. This module knows no
process, link or clock.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agents.messages.boundary_arrays import read_triangle
from agents.messages.packing import DownMessage, RoundMessage, UpMessage
from agents.peers.splits import Splits
from dsse_core.estimation.decision import (
    Decision,
    Memory,
    Totals,
    Verdict,
    add_totals,
    decide,
    find_omission,
    is_lost,
    name_next,
)
from dsse_core.exchange.area_estimation import FAILURES, AreaEstimation
from dsse_core.exchange.boundary_load import Loads
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.partition import Area
from dsse_core.grid.supply import Pieces
from dsse_core.linear.boundary_information import BEYOND_REASON, BoundaryInformation
from dsse_core.split_identity import SplitIdentity, SplitUse, find_newest

Known = dict[str, BoundaryInformation]


@dataclass(frozen=True)
class Decider:
    """The area that has added up all totals: ``name`` in its ``incarnation``."""

    name: str
    incarnation: tuple[int, int]


@dataclass(frozen=True)
class Outcome:
    """End of a term. All outcomes of one term and decider are equal."""

    verdict: Verdict
    totals: Totals
    decider: Decider


@dataclass(frozen=True)
class RoundContent:
    """Content of a message of a round, see ``RoundMessage``; None where the message leaves it empty."""

    information: BoundaryInformation | None
    no_load: BoundaryInformation | None
    power: tuple[float, ...]
    totals: Totals
    pieces: Pieces = ()


class AreaRound:
    """One area in the rounds of a term.

    ``k``: the round. ``outcome``: end of the term, None before. ``links``: the neighbours in use. ``splits``: of this
    area, its neighbours and its telemetry.
    """

    def __init__(self, area: Area, splits: Splits) -> None:
        self.estimation = AreaEstimation(area)
        self.k = 0
        self.links: frozenset[str] = frozenset()
        self.outcome: Outcome | None = None
        self._area = area
        self._splits = splits
        self._newest: SplitIdentity | None = None  # split of all areas, by the last totals of all
        self._memory = Memory()
        self._ups: dict[str, UpMessage] = {}
        self._sent = Totals()  # in Up(k)
        self._is_passed_on = False  # Up(k) has been sent, or decided on
        self._has_begun = False
        self._decided: tuple[Memory, Totals, tuple[Memory, Verdict]] | None = None

    @property
    def towards_hub(self) -> str | None:
        """The neighbour in use on the way to the hub; None in the area that decides."""
        return self._area.towards_hub if self._area.towards_hub in self.links else None

    @property
    def lower(self) -> list[str]:
        """The neighbours in use that are farther from the hub."""
        return [n.area for n in self._area.neighbours if n.area in self.links and n.area != self._area.towards_hub]

    @property
    def removed(self) -> tuple[str, ...]:
        """The meters of all areas that this term has taken out as bad data, and the switches that it has operated, in
        order.
        """
        return self._memory.removed

    @property
    def undecided(self) -> tuple[tuple[str, ...], ...]:
        """Each removed meter that the readings do not distinguish from others, with these others."""
        return tuple((meter, *others) for meter, others in zip(self.removed, self._memory.tied, strict=True) if others)

    @property
    def kept(self) -> str:
        """The meter that stays in use because no estimate was found without it; empty if there is none."""
        return self._memory.kept

    def enter(self, links: frozenset[str]) -> None:
        """Enters a new term with the neighbours ``links``; round 0 waits for ``begin``."""
        self.links, self.outcome, self._has_begun = links, None, False
        self._memory = Memory()
        self._go_to(0)

    def begin(
        self, readings: Sequence[Measurement], *, stale: bool, loads: Mapping[str, Loads], closed: Mapping[str, bool]
    ) -> None:
        """Begins round 0 with the readings of the term; ``loads``: neighbour -> net loads of its load message;
        ``closed``: switch of the area -> its status in this term.
        """
        silent = {n.area for n in self._area.neighbours} - self.links
        self._has_begun = True
        try:
            self.estimation.begin(readings, silent=silent, stale=stale, loads=loads, closed=closed)
        except FAILURES as error:
            self.estimation.fail(error)

    def _go_to(self, k: int) -> None:
        self.k, self._ups, self._is_passed_on = k, {}, False

    # Towards the hub

    def prepare(self) -> None:
        """Computes ahead while the messages of this round are under way."""
        if self._has_begun and self.outcome is None:
            try:
                self.estimation.prepare()
            except FAILURES as error:
                self.estimation.fail(error)

    def find_false_count(self, message: UpMessage) -> str:
        """Returns the false count of areas in Up(k), in words; empty if one side can have as many areas."""
        areas = message.totals.areas
        return "" if 0 < areas < self._area.n_areas else f"it counts {areas} areas on its side, of {self._area.n_areas}"

    def take_up(self, name: str, message: UpMessage) -> bool:
        """Keeps Up(k) of a neighbour; returns whether it is the first of this round."""
        if self.outcome is not None or name in self._ups:
            return False
        self._ups[name] = message
        return True

    @property
    def may_go_on(self) -> bool:
        """True where Up(k) may be sent, or, without a neighbour towards the hub, the totals decided on."""
        if self.outcome is not None or self._is_passed_on or not self._has_begun:
            return False
        return all(name in self._ups for name in self.lower)

    def add_up(self) -> Totals:
        """Returns the totals of this side at x_k, which the area now passes on or decides on."""
        self._is_passed_on = True
        for name, up in self._ups.items():
            if up.power:
                self.estimation.set_power(name, up.power)
        held = ((self._splits.held, 1),) if self._splits.held.digest else ()
        own = replace(self.estimation.totals(), splits=self._find_uses(), held=held)
        return add_totals([own, *(self._read(self._ups[name].totals) for name in self.lower)])

    def _find_uses(self) -> tuple[SplitUse, ...]:
        """The splits that this area knows of. An area names itself once it knows that its file is not of the newest."""
        own, others = self._splits.own, self._splits.others
        is_other = not own.is_sound or self._newest not in (None, own)
        named = (SplitUse(split, (name,)) for name, split in others.items())
        return (SplitUse(own, (self._area.name,) if is_other else ()), *named)

    def _read(self, totals: Totals) -> Totals:
        """Returns the totals of a neighbour without suspects of this area, which no other area can name, and without
        removed ones.
        """
        worst, tied = (tuple(n for n in named if not self._is_false(n[0])) for named in (totals.worst, totals.tied))
        return replace(totals, worst=worst, tied=tied)

    def _is_false(self, suspect: str) -> bool:
        return suspect in self.removed or self.estimation.owns(suspect)

    def find_up(self, totals: Totals) -> RoundContent:
        """Returns the content of Up(k)."""
        assert self.towards_hub is not None  # else it is decided
        name, information, no_load = self.towards_hub, None, None
        if not (totals.failed or self._memory.evaluating or is_lost(totals)):
            information = self._find_information(name, self._below())
        if self.estimation.failure:
            totals = add_totals([totals, Totals(failed=(self._area.name,))])
        elif self.estimation.is_first:
            no_load = self.estimation.no_load_for(name, self._no_load_below())
        self._sent = totals
        pieces = self.estimation.pieces_for(name, self._pieces_below())
        return RoundContent(information, no_load, self._find_power(name), totals, pieces)

    def _below(self) -> Known:
        return {name: information_of(up) for name, up in self._ups.items() if up.R}

    def _no_load_below(self) -> Known:
        return {name: no_load_of(up) for name, up in self._ups.items() if up.no_load}

    def _pieces_below(self) -> dict[str, Pieces]:
        return {name: up.pieces for name, up in self._ups.items() if up.pieces}

    def _find_information(self, name: str, known: Known) -> BoundaryInformation | None:
        """Returns the information for ``name``; None without numbers."""
        if self.estimation.failure:
            return None
        try:
            return self.estimation.information_for(name, {k: v for k, v in known.items() if k != name})
        except FAILURES as error:
            self.estimation.fail(error)
            return None

    def _find_power(self, name: str) -> tuple[float, ...]:
        power = () if self.estimation.failure else self.estimation.power_for(name)
        return tuple(np.clip(power, -BEYOND_REASON, BEYOND_REASON).tolist())  # beyond it the step is lost

    # From the hub

    def decide(self, totals: Totals) -> Verdict:
        """Returns the verdict on the totals of all areas, and keeps the memory that it leaves."""
        self._memory, verdict = self._decide(totals)
        return verdict

    def _decide(self, totals: Totals) -> tuple[Memory, Verdict]:
        """See ``decide``. The verdict on totals that are first checked and then followed is computed once."""
        if self._decided is None or self._decided[0] is not self._memory or self._decided[1] is not totals:
            memory, verdict = decide(self._memory, totals)
            self._decided = self._memory, totals, (memory, name_next(verdict, totals))
        return self._decided[2]

    def is_waited_for(self) -> bool:
        """True where Down(k) may come: Up(k) has been passed on, and the term has not ended."""
        return self._is_passed_on and self.outcome is None

    def find_lie(self, message: DownMessage) -> str:
        """Returns the fault of Down(k), in words; empty without one.

        A fault is: the totals leave out what was sent in Up(k); the verdict does not follow from the totals; a meter of
        this area is taken out that does not stand out here.
        """
        if omission := find_omission(message.totals, self._sent):
            return omission
        memory, verdict = self._decide(message.totals)
        if str(verdict) != message.verdict:
            return f"it says {message.verdict!r} where its totals say {str(verdict)!r}"
        newest = set(memory.removed[-1:] if verdict.decision is Decision.ANEW else ()) - set(self._memory.removed)
        if any(self.estimation.owns(suspect) for suspect in newest - self.estimation.reported):
            return f"it takes out {memory.removed[-1]}, which does not stand out here"
        return ""

    def find_other_end(self, k: int, is_final: bool) -> str:
        """Returns the fault of a neighbour that is at the end of this term before round ``k``, in words; else empty.

        All areas of a term find the same verdicts, so the end is the same for all.
        """
        if not is_final or self.outcome is not None or k > self.k:
            return ""  # the neighbour is not at its end, or this area may yet come to the same end
        return f"it is at the end after round {k - 1}, which for us was not the last"

    def descend(
        self, verdict: Verdict, totals: Totals, decider: Decider, down: DownMessage | None
    ) -> Iterator[tuple[str, RoundContent]]:
        """Carries out ``verdict``, which ``down`` brings if given; yields the content of Down(k) for each lower
        neighbour as soon as it is known.
        """
        self._newest = find_newest(totals.splits)
        known, no_load, pieces = self._below(), self._no_load_below(), self._pieces_below()
        if down is not None and self.towards_hub:
            known |= {self.towards_hub: information_of(down)} if down.R else {}
            no_load |= {self.towards_hub: no_load_of(down)} if down.no_load else {}
            pieces |= {self.towards_hub: down.pieces} if down.pieces else {}
        k, estimation, lower = self.k, self.estimation, self.lower
        is_first = estimation.is_first and not estimation.failure

        def find_content(name: str) -> RoundContent:
            information = self._find_information(name, known) if verdict.takes_step else None
            others = {n: information for n, information in no_load.items() if n != name}
            at_no_load = estimation.no_load_for(name, others) if is_first else None
            return RoundContent(information, at_no_load, (), totals, estimation.pieces_for(name, pieces))

        boundaries = self._area.boundaries
        need_powers = [name for name in lower if boundaries[name].needs_powers(name)]  # at x_{k+1}
        for name in lower:
            if name not in need_powers:
                yield name, find_content(name)  # as soon as it is known: its receiver computes meanwhile
        contents = {name: find_content(name) for name in need_powers}
        estimation.carry_out(verdict, self._memory, known, no_load, pieces)
        if down is not None and down.power and self.towards_hub:
            estimation.set_power(self.towards_hub, down.power)
        for name, content in contents.items():
            yield name, replace(content, power=self._find_power(name))
        if verdict.decision is Decision.FINAL:
            self.outcome = Outcome(verdict, totals, decider)
        self._go_to(k + 1)


def information_of(message: RoundMessage) -> BoundaryInformation:
    """Returns the information of a message: R as a matrix, (d, d), and z, (d,)."""
    return BoundaryInformation(read_triangle(message.R), np.array(message.z))


def no_load_of(message: RoundMessage) -> BoundaryInformation:
    """Returns the no-load information of a message, (d, d); it has no z, so z is zero."""
    R = read_triangle(message.no_load)
    return BoundaryInformation(R, np.zeros(len(R)))
