"""Bad data of the whole feeder, decided along the tree of areas as a control centre would decide.

Sums and the largest normalised residual climb from the leaves to the substation's area, which sends down the list
of its decisions: which meters to remove, and last to use current magnitudes, which mislead before the flows are known
and are held back anew after each removal: a bad meter may have turned the flow that they tell the size of.
That list is the epoch: only figures of the same list are combined, and only of neighbours that have heard each
other's last boundary message and have nothing more to say. That there will be no more decisions is said on the way
down under the same conditions, and is taken back as soon as they fail: it holds for no other information than that
from which it was found. Everything is absolute and may be lost, repeated or late.
What cannot be spared is found on the same way: each area tells its neighbours the cost-to-go of its meters at no
load, once it has heard it from all the others.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Sequence

import numpy as np

from agents.messages import BoundaryNews, Header, TallyMessage
from agents.strategies.interface import Knowledge
from agents.triangle import read_triangle, write_triangle
from dsse_core.area_model import AreaModel
from dsse_core.bad_data import CONFIDENCE, CRITICAL_REDUNDANCY, chi_square_limit
from dsse_core.boundary_information import BoundaryInformation
from dsse_core.feeder_bad_data import NoLoadModel, Tally, add_tallies, tally_area
from dsse_core.measurement import Measurement, MeasurementKind
from dsse_core.partition import Area, Neighbour

_NoLoad = dict[str, tuple[float, ...]]  # neighbour -> ``TallyMessage.no_load``
MAX_TIED = 20  # suspects of one side that are named; the first of them by name may be taken out
MAX_DECISIONS = 1000  # of one scan, and
MOST_NAMED = 25_000  # characters of names in a list: what all say about them must fit into a message
USE_CURRENTS = "use current magnitudes"  # the last decision, for now; the others are the id of the meter to be removed


class BadDataTree:
    """One area's part. ``decisions``: of the substation's area, in order.

    ``finished``: there will be no more, and nothing is under way anywhere in the feeder.
    """

    def __init__(self, area: Area, own_meters: Collection[str]) -> None:
        self._area = area
        self._own_meters = own_meters
        self._children = [n for n in area.neighbours if not n.is_parent]
        self._scan = 0
        self.decisions: tuple[str, ...] = ()
        self.finished = False
        self._searched: tuple[int, tuple[str, ...]] | None = None  # scan and decisions with which it last finished
        self.critical: tuple[str, ...] = ()
        self._tally: Tally | None = None  # of this side, final
        self._own: tuple[np.ndarray, set[str], Tally] | None = None  # what the area's own part rests on, and it
        self._no_load: NoLoadModel | None = None
        self._no_load_decisions: tuple[str, ...] = ()  # that it follows
        self._held_back = 0
        self._indispensable: tuple[object, set[str]] | None = None
        self._told_no_load: dict[str, tuple[object, tuple[float, ...]]] = {}  # what it was made from, and it
        self._known = Knowledge(())

    @property
    def searched(self) -> bool:
        """Whether it has finished with these decisions in this scan, whatever has come up since."""
        return self._searched == (self._scan, self.decisions)

    def adopt(self, known: Knowledge) -> None:
        """Take over what the side of the substation has decided; a new scan starts anew."""
        self._known = known
        if known.scan != self._scan:
            self._scan = known.scan
            self.decisions = ()
        parent = self._area.parent
        order = known.tallies.get(parent.area) if parent else None
        if order is not None:
            self.decisions = order.decisions

    def select(self, telemetry: Sequence[Measurement]) -> list[Measurement]:
        """The measurements that the decisions so far leave in use."""
        held_back = () if USE_CURRENTS in self.decisions else (MeasurementKind.CURRENT,)
        removed = set(self.decisions)
        return [m for m in telemetry if m.meter.kind not in held_back and not (removed and m.meter.id in removed)]

    def take_measurements(self, no_load: NoLoadModel, held_back: int) -> None:
        """The measurements have changed, by a new scan or a decision; ``held_back``: how many are not yet in use."""
        if no_load is not self._no_load:
            self._no_load = no_load
            self._indispensable = None
            self._told_no_load = {}
        self._no_load_decisions = self.decisions
        self._held_back = held_back
        self._tally = self._own = None

    def judge(
        self,
        model: AreaModel,
        x: np.ndarray,
        find_variance: Callable[[], np.ndarray],
        settled: bool,
        known: Knowledge,
    ) -> None:
        """Add up this side's figures where all of them are final; the substation's area decides, others hear from it.

        ``find_variance``: diag(Omega) at ``x``; asked for it if that is needed.
        """
        self._known = known
        self._tally, self.finished = None, False
        no_load = self._heard_no_load()
        children = [known.tallies.get(n.area) for n in self._children]
        if not settled or len(no_load) < len(self._area.neighbours):
            return
        own = self._tally_own(model, x, find_variance, no_load)
        final = [
            t for t, n in zip(children, self._children, strict=True) if t and t.settled and self._is_last_word(t, n)
        ]
        if len(final) < len(self._children):
            return
        below = [self.read(t) for t in final]
        self._tally = add_tallies([own, *below])
        parent = self._area.parent
        if parent is None:
            self._decide(self._tally)
        else:
            order = known.tallies.get(parent.area)
            self.finished = order is not None and order.finished and self._is_last_word(order, parent)
        if self.finished:
            self._searched = (self._scan, self.decisions)

    def _decide(self, tally: Tally) -> None:
        exceeds = tally.objective >= chi_square_limit(tally.degrees_of_freedom, CONFIDENCE)
        if tally.held_back and USE_CURRENTS not in self.decisions:
            decision = USE_CURRENTS
        elif exceeds and tally.worst:
            decision = min(tally.worst)
        else:
            self.finished = True
            return
        decisions = (*(d for d in self.decisions if d != USE_CURRENTS), decision)
        if has_too_many_names(decisions):  # somebody makes up meters, and would do so for ever
            self.finished = True
            return
        self.decisions = decisions
        self._tally = None

    def message_for(self, neighbour: Neighbour, header: Header) -> TallyMessage:
        sent, heard = self._known.sent.get(neighbour.area), self._known.boundary.get(neighbour.area)
        up = self._tally if neighbour.is_parent else None
        finished = self.finished and not neighbour.is_parent
        holds = up is not None or finished
        worst = dict(itertools.islice(up.worst.items(), MAX_TIED)) if up else {}
        return TallyMessage(
            header=header,
            bus=neighbour.bus,
            decisions=self.decisions,
            finished=finished,
            settled=up is not None,
            sent=_order(sent) if holds else (),
            heard=_order(heard) if holds else (),
            objective=up.objective if up else 0.0,
            degrees_of_freedom=up.degrees_of_freedom if up else 0,
            held_back=up.held_back if up else 0,
            worst=tuple(worst),
            normalized=tuple(worst.values()),
            no_load=self._no_load_for(neighbour),
        )

    def _is_last_word(self, tally: TallyMessage, neighbour: Neighbour) -> bool:
        """Whether nothing is under way between us and ``neighbour``, who is in our epoch."""
        return (
            tally.decisions == self.decisions
            and tally.sent == _order(self._known.boundary.get(neighbour.area))
            and tally.heard == _order(self._known.sent.get(neighbour.area))
        )

    def read(self, message: TallyMessage) -> Tally:
        """Nobody else can name a meter of this area, nor one that is out already."""
        named = zip(message.worst, message.normalized, strict=True)
        worst = {m: value for m, value in named if m not in self._own_meters and m not in self.decisions}
        return Tally(message.objective, message.degrees_of_freedom, worst, message.held_back)

    def _tally_own(
        self,
        model: AreaModel,
        x: np.ndarray,
        find_variance: Callable[[], np.ndarray],
        no_load: _NoLoad,
    ) -> Tally:
        """The area's own figures, made anew only when what they rest on has changed."""
        indispensable = self._find_indispensable(no_load)
        if self._own is None or self._own[0] is not x or self._own[1] != indispensable:
            variance = find_variance()
            without_check = (variance <= CRITICAL_REDUNDANCY * model.sigma**2) & ~model.virtual
            real = {model.meters[k].id for k in np.flatnonzero(~model.virtual)} if indispensable else set()
            critical = {model.meters[k].id for k in np.flatnonzero(without_check)} | (indispensable & real)
            self.critical = tuple(m.id for m in model.meters if m.id in critical) if critical else ()
            self._own = (x, indispensable, tally_area(model, x, variance, critical, self._held_back))
        return self._own[2]

    def _find_indispensable(self, no_load: _NoLoad) -> set[str]:
        assert self._no_load is not None  # there are measurements
        if self._indispensable is None or self._indispensable[0] != no_load:
            self._indispensable = (no_load, self._no_load.find_indispensable(_read_no_load(no_load)))
        return self._indispensable[1]

    def _heard_no_load(self) -> _NoLoad:
        """Of the neighbours that follow the same decisions."""
        tallies = self._known.tallies.items()
        return {name: t.no_load for name, t in tallies if t.no_load and t.decisions == self.decisions}

    def _no_load_for(self, neighbour: Neighbour) -> tuple[float, ...]:
        heard = {name: told for name, told in self._heard_no_load().items() if name != neighbour.area}
        if (
            self._no_load is None
            or self._no_load_decisions != self.decisions
            or len(heard) < len(self._area.neighbours) - 1
        ):
            return ()
        last = self._told_no_load.get(neighbour.area)
        if last is None or last[0] != heard:
            information = self._no_load.information_for(neighbour, _read_no_load(heard))
            last = self._told_no_load[neighbour.area] = (heard, write_triangle(information.R))
        return last[1]


def has_too_many_names(names: Collection[str]) -> bool:
    """Whether there are more than any feeder has bad readings, or a message has room for."""
    return len(names) > MAX_DECISIONS or sum(map(len, names)) > MOST_NAMED


def _read_no_load(told: _NoLoad) -> dict[str, BoundaryInformation]:
    return {name: BoundaryInformation(read_triangle(numbers), np.zeros(4)) for name, numbers in told.items()}


def _order(message: BoundaryNews | None) -> tuple[int, ...]:
    if message is None:
        return ()
    incarnation, sequence = message.header.order
    return (incarnation.start_ms, incarnation.random, sequence)
