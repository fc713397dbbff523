"""What an area publishes under rounds: its state once a scan at rest, what that is worth, and what is missing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

from agents.area_round import AreaRound, Outcome
from agents.hearing import PASSED_ON_BEATS
from agents.messages import Header, Message, StateMessage, content_of
from agents.peer_table import PeerTable
from agents.peers import Term
from agents.quality import DEGRADED, GOOD, NONE, RELATIVE_ANGLE, STALE, UNOBSERVABLE
from agents.scan_readings import ScanReadings
from agents.shown_state import describe_estimate
from agents.strategies.interface import Estimate
from dsse_core.area_estimation import FAILURES
from dsse_core.bad_data import chi_square_limit
from dsse_core.partition import Area
from dsse_core.verdict import UNOBSERVABLE as NOT_OBSERVABLE
from dsse_core.verdict import Totals

CONTRADICTION = 0.9999  # confidence of the chi-square test of what is shown; bad data are looked for at a lower one
MISMATCH = 1e-6  # p.u. and rad, of the final voltages that two sides of a boundary have; rounding leaves 1e-8

Counts = Callable[[], tuple[Mapping[str, int], Mapping[str, int], Mapping[str, int]]]


class RoundsState:
    """The state as last published, and what it rests on."""

    def __init__(self, area: Area, peers: PeerTable, round: AreaRound, scan: ScanReadings) -> None:
        self._area = area
        self._peers = peers
        self._round = round
        self._scan = scan
        self._buses = tuple(bus.id for bus in area.network.buses)
        self._message: StateMessage | None = None
        self._estimate: Estimate | None = None
        self._outcome: Outcome | None = None  # which the estimate is of
        self._of_scan = 0
        self._notes: tuple[str, ...] = ()
        self._gaps: dict[str, tuple[Outcome, tuple[float, ...], tuple[float, float]]] = {}  # as _find_gap found them

    def show(
        self,
        term: Term,
        now: float,
        ahead: Mapping[str, float],
        counts: Counts,
        header_for: Callable[[Message | None], Header],
        *,
        is_beat: bool,
    ) -> StateMessage | None:
        """The state to be published at time ``now``, if any is.

        ``ahead``: senders refused as from the future -> by how much, s. ``counts()``: sequence numbers of load messages
        sent and heard by neighbour, and what was refused by reason.
        """
        outcome = self._round.outcome
        if outcome is not None and outcome is not self._outcome:
            self._outcome, self._of_scan = outcome, term[0]
            self._estimate, self._notes = self._read(outcome)
        elif not is_beat and self._message is not None and self._is_as_shown(term, now, ahead):
            return None
        elif self._message is None and term[0] and outcome is None:
            return None  # the first estimate is under way
        state = self._compose(term, now, ahead, counts, header_for)
        last = self._message
        if last is not None and content_of(last) == content_of(state) and last.header.scan == state.header.scan:
            state = replace(state, header=replace(state.header, sequence=last.header.sequence))
        self._message = state
        return state

    def _is_as_shown(self, term: Term, now: float, ahead: Mapping[str, float]) -> bool:
        assert self._message is not None
        return (
            self._message.quality == self._quality(term, now)
            and (not ahead) == (not any("in the future" in note for note in self._message.notes))
            and self._message.old_sides == self._old_sides(term, now)
        )

    def _read(self, outcome: Outcome) -> tuple[Estimate | None, tuple[str, ...]]:
        """What the term has ended with, and in words what is missing or wrong."""
        estimation, notes = self._round.estimation, list(self._notes_on(outcome))
        if not estimation.failure and outcome.verdict.reason != NOT_OBSERVABLE:
            try:
                return self._read_estimate(outcome), tuple(notes)
            except FAILURES as error:
                estimation.fail(error)
        if estimation.failure:
            notes.insert(0, f"no estimate: {estimation.failure}")
        return None, tuple(notes)

    def _read_estimate(self, outcome: Outcome) -> Estimate:
        estimation = self._round.estimation
        sigma_vm, sigma_va, critical = estimation.find_sigmas()
        (vm, va), totals = estimation.voltages, estimation.totals()
        estimate = Estimate(
            vm=vm,
            va=va,
            sigma_vm=sigma_vm,
            sigma_va=sigma_va,
            referenced=outcome.totals.referenced,
            objective=totals.objective,
            degrees_of_freedom=totals.degrees_of_freedom,
            removed=(*estimation.dead_voltmeters, *estimation.removed),
            critical=critical,
            checked=self._counts_all(outcome),
        )
        if not estimate.is_reasonable(estimation.no_load_va):
            raise ArithmeticError("it is beyond reason")
        return estimate

    def _counts_all(self, outcome: Outcome) -> bool:
        """Whether the verdict rests on every area of the grid."""
        totals = outcome.totals
        return totals.areas == self._area.n_areas and not totals.silent and not outcome.verdict.reason

    def _notes_on(self, outcome: Outcome) -> Iterator[str]:
        """What the end of a term leaves to be said; it stays until the next one."""
        totals = outcome.totals
        if outcome.verdict.reason == NOT_OBSERVABLE:
            dead = self._round.estimation.dead_voltmeters
            left_out = f"; left out as dead: {', '.join(dead)}" if dead else ""
            yield f"not observable: no reading of this scan determines buses {', '.join(totals.unobservable)}{left_out}"
        elif totals.failed:
            yield f"no estimate in {', '.join(totals.failed)}"
        elif outcome.verdict.reason:
            yield f"the iteration has not converged: last step {totals.step:.3g} p.u. or rad"
        elif _exceeds_limit(totals):
            yield (
                f"readings contradict each other (J {totals.objective:.4g} with {totals.degrees_of_freedom} degrees of "
                "freedom), and no meter stands out that can be spared"
            )
        for n in self._area.neighbours:
            if n.area in self._peers.distrusted:
                yield f"{n.area} is not believed: {self._peers.distrusted[n.area]}"
            elif n.area not in self._round.links:
                yield f"no information from {n.area}"
        if self._scan.stale:
            yield "no readings of this scan; the last ones stand in"
        if others := [name for name in totals.stale if name != self._area.name]:
            yield f"no readings of this scan in {', '.join(others)}"
        if totals.areas != self._area.n_areas:
            yield f"{totals.areas} of {self._area.n_areas} areas are counted"

    def _passing_notes(self, term: Term, ahead: Mapping[str, float]) -> Iterator[str]:
        yield from self._mismatches(term)
        for name, farewell in sorted(self._peers.gone.items()):
            yield f"neighbour {name} has left: {farewell}" if farewell else f"neighbour {name} is gone"
        for name, lead in sorted(ahead.items()):
            yield (
                f"{name or 'telemetry'} is refused, from {lead:.0f} s in the future: the clock of this area is behind, "
                "or that of the sender ahead; set it, then start its process again"
            )
        if self._scan.has_been_read and (silent := self._scan.readings.silent):
            yield f"no reading from {len(silent)} meters, the first is {silent[0]}"

    def _mismatches(self, term: Term) -> Iterator[str]:
        """Neighbours whose final voltage at the boundary is another than ours: somebody on that side says false things.

        Rounding leaves less, and without a lie both sides take the same steps.
        """
        outcome, estimation = self._round.outcome, self._round.estimation
        if outcome is None or outcome.verdict.reason or estimation.failure:
            return
        for name, peer in sorted(self._peers.items()):
            if peer.term != term or not peer.final or not peer.y or name not in self._round.links:
                continue
            dvm, dva = self._find_gap(name, outcome, peer.y)
            if max(dvm, dva) > MISMATCH:
                yield (
                    f"boundary mismatch with {name} at bus {peer.bus}: its final voltage differs by {dvm:.3g} p.u. and "
                    f"{math.degrees(dva):.3g} deg; one of the two sides says false things"
                )

    def _find_gap(self, name: str, outcome: Outcome, theirs: tuple[float, ...]) -> tuple[float, float]:
        """By how much (vm, va) at a boundary differ, p.u. and rad; asked for at every event, found once."""
        kept = self._gaps.get(name)
        if kept is None or kept[0] is not outcome or kept[1] != theirs:
            _, _, vm, va = self._round.estimation.boundary_values(name)
            gap = abs(vm - theirs[2]), abs(math.remainder(va - theirs[3], 2 * math.pi))
            self._gaps[name] = kept = outcome, theirs, gap
        return kept[2]

    def _quality(self, term: Term, now: float) -> str:
        """The worst that holds now."""
        outcome, estimate = self._outcome, self._estimate
        if outcome is not None and outcome.verdict.reason == NOT_OBSERVABLE:
            return UNOBSERVABLE
        if outcome is None or estimate is None:
            return NONE
        if self._scan.is_late(now) or self._scan.stale:
            return STALE
        if not estimate.referenced:
            return RELATIVE_ANGLE
        is_sound = outcome is self._round.outcome and self._counts_all(outcome) and not outcome.totals.stale
        is_sound = is_sound and not self._scan.are_outdated and not _exceeds_limit(outcome.totals)
        is_sound = is_sound and not any(self._mismatches(term))
        return GOOD if is_sound and not self._peers.find_old(term, self._round.links, now) else DEGRADED

    def is_side_complete(self, name: str, term: Term, now: float) -> bool:
        """Whether all on this side of neighbour ``name`` is heard, fresh, at the end of this term and agrees."""
        if self._round.outcome is None or self._scan.is_late(now, PASSED_ON_BEATS) or self._scan.are_outdated:
            return False
        if any(self._mismatches(term)):
            return False
        return not self._peers.find_old(term, self._round.links, now, PASSED_ON_BEATS) - {name}

    def _old_sides(self, term: Term, now: float) -> tuple[str, ...]:
        """Neighbours that say that their side is not complete."""
        old = self._peers.find_old(term, self._round.links, now)
        return tuple(sorted(name for name in old if not self._peers[name].complete))

    def _estimate_now(self, term: Term) -> Estimate | None:
        """The estimate, which has not been checked as long as a neighbour contradicts it."""
        if self._estimate is None or not any(self._mismatches(term)):
            return self._estimate
        return replace(self._estimate, checked=False)

    def _compose(
        self,
        term: Term,
        now: float,
        ahead: Mapping[str, float],
        counts: Counts,
        header_for: Callable[[Message | None], Header],
    ) -> StateMessage:
        loads, heard_loads, refused = counts()
        peers = sorted(self._peers.items())
        waiting = () if self._scan.has_been_read or term[0] else ("no telemetry yet",)
        return StateMessage(
            header=replace(header_for(self._message), scan=self._of_scan or term[0]),
            **describe_estimate(self._estimate_now(term), self._buses),
            sent={name: (loads.get(name, 0), peer.sequence) for name, peer in peers},
            heard={name: (heard_loads.get(name, 0), peer.heard_sequence) for name, peer in peers},
            messages=0,
            bytes=0,
            lost=0,
            notes=(*waiting, *self._notes, *self._passing_notes(term, ahead)),
            faults={},
            quality=self._quality(term, now),
            telemetry_age=self._scan.age(now),
            ages={name: now - peer.heard_at for name, peer in peers if peer.heard_at > -math.inf},
            scans={name: peer.term[0] for name, peer in peers if peer.incarnation is not None},
            old_sides=self._old_sides(term, now),
            refused=dict(refused),
        )


def _exceeds_limit(totals: Totals) -> bool:
    """Whether J at the end is more than noise alone leaves in all but one of ten thousand scans."""
    return totals.objective >= chi_square_limit(totals.degrees_of_freedom, CONTRADICTION)
