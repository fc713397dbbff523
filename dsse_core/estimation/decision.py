"""Verdict on the next move of all areas: a pure function of the totals of all areas and of the memory of the term.

The areas together take the Gauss-Newton steps of the whole grid. Step control, the end of the iteration and bad data
are decided here, without a clock, so that every area that has the totals comes to the same verdict. The centralised
estimator is one area without neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from dsse_core import gauss_newton
from dsse_core.estimation.residuals import CONFIDENCE, chi_square_limit, find_switches, find_taps, keep_equal, keep_tied
from dsse_core.gauss_newton import FULL_STEPS, LAST_STEP, MOST_STEPS
from dsse_core.grid.gauge import Change
from dsse_core.linear.boundary_information import BEYOND_REASON
from dsse_core.split_identity import HeldSplits, SplitUse, add_held, add_uses

MOST_REMOVED = 1000  # meters of one scan; an area that reports more is faulty, and would never stop
MOST_NAMED = 20  # areas, splits or ranges of buses that totals name


class Decision(StrEnum):
    """Decision on the next move of all areas.

    ``STEP``: the areas take ``share`` of the Gauss-Newton step. ``SHORTEN``: of the last step they take only ``share``.
    ``USE_CURRENTS``: they use current magnitudes, which are held back until flows are known. ``EVALUATE``: they find
    normalised residuals. ``ANEW``: they begin again at the start of the scan, without the meters removed. ``FINAL``:
    the scan ends.
    """

    STEP = "step"
    SHORTEN = "shorten"
    USE_CURRENTS = "use currents"
    EVALUATE = "evaluate"
    ANEW = "anew"
    FINAL = "final"


UNOBSERVABLE, DIVERGED, NO_ESTIMATE = "unobservable", "diverged", "no estimate"  # reasons of an end without success
OUT_OF_REACH = "out of reach"  # another: the steps of a start lead to no state that fits the readings
STEPS_USED_UP = "steps used up"  # reason of an end with an estimate, after which no more bad data is looked for


class IterationLostError(Exception):
    """The iteration has no end. ``weighted``: |r| / sigma of all meters where it has stopped, (n_meas,).

    ``reason``: DIVERGED or OUT_OF_REACH. ``cause``: the cause, where the end tells it.
    """

    def __init__(
        self, iterations: int, step: float, weighted: np.ndarray, reason: str = DIVERGED, cause: str = ""
    ) -> None:
        super().__init__(f"no end after {iterations} iterations")
        self.iterations, self.step, self.weighted, self.reason = iterations, step, weighted, reason
        self.cause = cause


@dataclass(frozen=True)
class Totals:
    """Totals of some areas at the state x_k; p.u. and rad.

    ``objective``: J of the areas' real meters in use, with ``degrees_of_freedom``. ``dvm``, ``dva``: the largest
    changes of the last step. ``square``, ``turn``: products of the last step, over the voltages of the areas' own
    buses, with itself and with the step before it. ``held_back``: number of current magnitudes not yet in use.
    ``worst``: (meter, normalised residual), the largest above the threshold and those that equal it, by id; empty
    unless evaluating. ``areas``: number of the areas. ``referenced``: one of the areas knows the substation's angle.
    ``silent``: neighbours that are not received. ``stale``: areas without readings of the scan. ``unobservable``: buses
    that no meter determines. ``failed``: areas that have no numbers. ``splits``: the splits on which the areas work,
    the oldest first; no verdict depends on them. ``held``: the next splits whose files areas hold, each with the number
    of these areas.
    """

    objective: float = 0.0
    degrees_of_freedom: int = 0
    dvm: float = 0.0
    dva: float = 0.0
    held_back: int = 0
    worst: tuple[tuple[str, float], ...] = ()
    areas: int = 0
    referenced: bool = False
    silent: tuple[str, ...] = ()
    stale: tuple[str, ...] = ()
    unobservable: tuple[str, ...] = ()
    failed: tuple[str, ...] = ()
    splits: tuple[SplitUse, ...] = ()
    tied: tuple[tuple[str, float], ...] = ()
    # Critical meters whose normalised residual equals the largest of ``worst``, by id. They stay, and may be wrong.
    held: HeldSplits = ()
    square: float = 0.0
    turn: float = 0.0
    energised: tuple[str, ...] = ()  # voltmeters that read a voltage where no closed branch leads to the substation
    dark: tuple[str, ...] = ()  # open branches with such an end
    common: tuple[Change, ...] = ()  # of parts without ground but by shunts, since the split

    @property
    def step(self) -> float:
        """The largest change of any voltage, p.u. or rad."""
        return max(self.dvm, self.dva)


def add_totals(parts: Iterable[Totals]) -> Totals:
    """Totals of several sides together."""
    parts = list(parts)
    worst = keep_tied(dict(named for t in parts for named in t.worst))
    tied = keep_equal(dict(named for t in parts for named in t.tied), worst)
    return Totals(
        objective=limit_total(sum(t.objective for t in parts)),
        degrees_of_freedom=sum(t.degrees_of_freedom for t in parts),
        dvm=max(t.dvm for t in parts),
        dva=max(t.dva for t in parts),
        held_back=sum(t.held_back for t in parts),
        worst=tuple(worst.items())[:MOST_NAMED],
        areas=sum(t.areas for t in parts),
        referenced=any(t.referenced for t in parts),
        silent=_add_names(t.silent for t in parts),
        stale=_add_names(t.stale for t in parts),
        unobservable=tuple(sorted((r for t in parts for r in t.unobservable), key=_first_bus))[:MOST_NAMED],
        failed=_add_names(t.failed for t in parts),
        splits=add_uses((use for t in parts for use in t.splits), MOST_NAMED),
        tied=tuple(tied.items())[:MOST_NAMED],
        held=add_held((t.held for t in parts), MOST_NAMED),
        square=limit_total(sum(t.square for t in parts)),
        turn=limit_total(sum(t.turn for t in parts)),
        energised=_add_names(t.energised for t in parts),
        dark=_add_names(t.dark for t in parts),
        common=_add_changes(change for t in parts for change in t.common),
    )


def limit_total(size: float) -> float:
    """``size`` as totals state it, BEYOND_REASON at most, of either sign.

    A larger number changes no verdict, and its receiver would reject it.
    """
    return max(min(size, BEYOND_REASON), -BEYOND_REASON)


def find_omission(totals: Totals, part: Totals) -> str:
    """Text that names what ``totals`` leave out of the totals ``part`` of some of their areas; empty if nothing.

    ``part`` never covers all areas. Sums only grow, however they are rounded; lists of names end at MOST_NAMED.
    """
    if totals.areas <= part.areas:
        return f"it counts {totals.areas} areas where {part.areas} on this side are not all"
    for name in ("silent", "stale", "unobservable", "failed", "energised", "dark"):
        names = getattr(totals, name)
        if len(names) < MOST_NAMED and (missing := set(getattr(part, name)) - set(names)):
            return f"it leaves out of what is {name}: {', '.join(sorted(missing))}"
    splits = {use.split for use in totals.splits}
    if len(splits) < MOST_NAMED and (left_out := [use.split for use in part.splits if use.split not in splits]):
        return f"it leaves out that areas work on {left_out[0]}"
    for name in ("objective", "dvm", "dva", "square", "held_back", "referenced"):
        if getattr(totals, name) < (least := getattr(part, name)):
            return f"it says {name} {getattr(totals, name):.6g} where this side alone has {least:.6g}"
    return ""


def _first_bus(buses: str) -> int:
    """First bus of a range such as "12-19", or that of a node; 0 where the text begins with no number."""
    number = buses.replace(".", "-").partition("-")[0]
    return int(number) if number.isdecimal() else 0


def _add_changes(changes: Iterable[Change]) -> tuple[Change, ...]:
    total: dict[int, np.ndarray] = {}
    for part, *change in changes:
        total[part] = total.get(part, 0.0) + np.array(change)
    limited = ((part, map(limit_total, of_part.tolist())) for part, of_part in sorted(total.items()))
    return tuple((part, a, b, c, d) for part, (a, b, c, d) in limited)[:MOST_NAMED]


def _add_names(parts: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(sorted({name for part in parts for name in part}))[:MOST_NAMED]


@dataclass(frozen=True)
class Memory:
    """State of a term on which decisions rest beside the totals; all areas of the term have the same.

    ``removed``: meters taken out as bad data, and switches that take the other status (``name_switch``), in order.
    ``tied``: for each of them those whose residual equalled its own then, by id; the readings do not tell which of them
    is wrong. ``kept``: the meter without which no estimate was found, or such a switch. It is as it was again, and no
    other is taken out. ``steps``: number of steps since the last start.
    ``share``: the part that was taken of the last step. ``before``: the size of the last but one step where it can be
    compared with the last, else 0. ``share_before``, ``square_before``: the share of the last but one step, and its
    product with itself, 0 where that step was corrected. ``objective``: J before the last step. ``stepped``: the last
    step is not corrected.
    ``from_flat_start``: the start of the scan has led to no end with these meters. ``spent``: number of steps of all
    starts before. ``common``: the changes by which that start differs from the one of the split.
    """

    removed: tuple[str, ...] = ()
    tied: tuple[tuple[str, ...], ...] = ()
    kept: str = ""
    steps: int = 0
    share: float = 1.0
    before: float = 0.0
    stepped: bool = False
    uses_currents: bool = False
    evaluating: bool = False
    from_flat_start: bool = False
    spent: int = 0
    share_before: float = 1.0
    square_before: float = 0.0
    objective: float = 0.0
    common: tuple[Change, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """Decision with its details, the same for all areas.

    ``share``: the part of the step that is taken. ``with_step``: the areas take the coming step, the last one, with
    the decision. ``reason``: the reason of an end without success, or STEPS_USED_UP. ``next_split``: digest of the
    split whose files all areas hold, and on which the next scan rests; empty without one.
    """

    decision: Decision
    share: float = 1.0
    with_step: bool = False
    reason: str = ""
    next_split: str = ""

    def __str__(self) -> str:
        parts = [self.decision.value, *([f"{self.share:.17g}"] if self.share != 1 else [])]
        text = " ".join([*parts, *(["after a last step"] if self.with_step else []), self.reason]).strip()
        return f"{text}, next split {self.next_split}" if self.next_split else text

    @property
    def takes_step(self) -> bool:
        return self.decision is Decision.STEP or self.with_step


def decide(memory: Memory, totals: Totals, tolerance: float = LAST_STEP) -> tuple[Memory, Verdict]:
    """Memory for the next verdict, and the verdict on ``totals``; ``tolerance``: see ``gauss_newton.next_step``."""
    if totals.unobservable:
        if find_switches(memory.removed[-1:]):
            return _give_up(memory, UNOBSERVABLE)
        return memory, Verdict(Decision.FINAL, reason=UNOBSERVABLE)
    if totals.failed:
        return _give_up(memory, NO_ESTIMATE)
    if memory.evaluating:
        return _remove_worst(memory, totals)
    flows_known, before = memory.uses_currents or not totals.held_back, 0.0
    verdict, share = gauss_newton.correct_step(memory.share, memory.stepped, flows_known, totals.dva, totals.dvm)
    is_far = verdict != gauss_newton.LOST and gauss_newton.is_out_of_reach(totals.dvm)
    if is_far:
        verdict = gauss_newton.LOST
    if verdict == gauss_newton.GO_ON:
        limit = chi_square_limit(totals.degrees_of_freedom, CONFIDENCE)
        coming = gauss_newton.choose_share(
            memory.steps, memory.uses_currents, memory.share_before, memory.square_before, totals.square, totals.turn
        )
        verdict, share, before = gauss_newton.next_step(
            memory.steps, memory.share, memory.stepped, memory.before, totals.step, flows_known, memory.uses_currents,
            totals.objective, totals.objective - memory.objective, limit, tolerance, MOST_STEPS, coming,
        )  # fmt: skip
    match verdict:
        case gauss_newton.SHORTEN:
            return _forget_step(memory), Verdict(Decision.SHORTEN, share)
        case gauss_newton.USE_CURRENTS:
            return replace(_forget_step(memory), uses_currents=True), Verdict(Decision.USE_CURRENTS)
        case gauss_newton.EVALUATE if not memory.kept:
            return replace(memory, evaluating=True), Verdict(Decision.EVALUATE, with_step=True)
        case gauss_newton.FINAL | gauss_newton.EVALUATE:
            return memory, Verdict(Decision.FINAL, with_step=True)
        case gauss_newton.LOST if memory.from_flat_start:
            return _give_up(memory, OUT_OF_REACH if is_far else DIVERGED)
        case gauss_newton.LOST:
            return begin_at_flat_start(memory, totals.common), Verdict(Decision.ANEW)
    square = totals.square if memory.stepped else 0.0
    memory = replace(
        memory,
        steps=memory.steps + 1,
        share=share,
        before=before,
        stepped=True,
        share_before=memory.share,
        square_before=square,
        objective=totals.objective,
    )
    return memory, Verdict(Decision.STEP, share)


def _forget_step(memory: Memory) -> Memory:
    """Memory with the last step corrected, so that no other step can be compared with it."""
    return replace(memory, stepped=False, before=0.0, square_before=0.0)


def name_next(verdict: Verdict, totals: Totals) -> Verdict:
    """``verdict``, with the digest of the one next split whose files all areas of ``totals`` hold, if it is the end."""
    if verdict.decision is not Decision.FINAL or len(totals.held) != 1 or totals.held[0][1] != totals.areas:
        return verdict
    return replace(verdict, next_split=totals.held[0][0].digest)


def is_lost(totals: Totals) -> bool:
    """True where the last step has led to no state, so that no information is asked for there."""
    return not totals.step <= gauss_newton.LARGEST_STEP or gauss_newton.is_out_of_reach(totals.dvm)


def begin_at_flat_start(memory: Memory, common: tuple[Change, ...] = ()) -> Memory:
    """Memory of a second start, at the flat start with the same meters, as the start of the scan has led to no end."""
    spent = memory.spent + memory.steps
    return Memory(memory.removed, memory.tied, memory.kept, from_flat_start=True, spent=spent, common=common)


def _give_up(memory: Memory, reason: str) -> tuple[Memory, Verdict]:
    """Verdict where there is no estimate: again with the meter that was taken out last, or the end where none was.

    The one removed before stays out.
    """
    if memory.kept or not memory.removed:
        return memory, Verdict(Decision.FINAL, reason=reason)
    spent = memory.spent + memory.steps
    return Memory(memory.removed[:-1], memory.tied[:-1], memory.removed[-1], spent=spent), Verdict(Decision.ANEW)


def are_steps_used_up(memory: Memory) -> bool:
    """True where the scan has no steps left for a further start without a meter.

    A scan may take all steps of two starts, with the bad meter and without it, and FULL_STEPS more for each meter taken
    out. So each meter found pays for the search for the next one, however many there are.
    """
    most = 4 * MOST_STEPS + FULL_STEPS * len(memory.removed)
    return memory.spent + memory.steps > most


def _remove_worst(memory: Memory, totals: Totals) -> tuple[Memory, Verdict]:
    """Verdict after evaluating: removes the meter with the largest normalised residual, of equal ones the first by id;
    a switch takes its other status.

    The scan ends without a removal where no residual stands out, where the largest is that of a tap, as then no meter
    need be to blame, or where the step taken with the decision has brought J below the limit.
    """
    suspects = dict(totals.worst)
    if not suspects or find_taps(suspects) or not _exceeds_limit(totals) or len(memory.removed) >= MOST_REMOVED:
        return replace(memory, evaluating=False), Verdict(Decision.FINAL)
    if are_steps_used_up(memory):
        return replace(memory, evaluating=False), Verdict(Decision.FINAL, reason=STEPS_USED_UP)
    first, *others = [meter for meter, _ in totals.worst]
    tied = tuple(sorted([*others, *(meter for meter, _ in totals.tied)]))
    removed, spent = (*memory.removed, first), memory.spent + memory.steps
    return Memory(removed=removed, tied=(*memory.tied, tied), spent=spent), Verdict(Decision.ANEW)


def _exceeds_limit(totals: Totals) -> bool:
    return totals.objective >= chi_square_limit(totals.degrees_of_freedom, CONFIDENCE)
