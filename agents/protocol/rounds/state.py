"""State that an area publishes under rounds, once a scan at rest: its estimate, its quality, and its gaps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

from agents.messages.packing import StateMessage
from agents.peers.orders_and_ages import PASSED_ON_HEARTBEATS
from agents.peers.peer_table import PeerTable
from agents.peers.peers import Term
from agents.peers.rejections import Rejections
from agents.peers.splits import Splits
from agents.protocol.configuration import Configuration
from agents.protocol.gateway_watch import GatewayWatch
from agents.protocol.numbering import ScanReadings
from agents.protocol.published_state import PublishedState
from agents.protocol.quality import (
    DEGRADED,
    NONE,
    RELATIVE_ANGLE,
    STALE,
    UNOBSERVABLE,
    EstimateLimits,
    Finding,
    assess,
    find_contradictions,
    find_dead_sections,
    find_doubtful_switches,
    find_early_scan,
    find_far_scans,
    find_gone,
    find_leader_clock,
    find_left_out_readings,
    find_meters_off,
    find_missing_readings,
    find_missing_side,
    find_mistaken_gateways,
    find_next_split,
    find_other_splits,
    find_overdue_readings,
    find_rejected_clocks,
    find_skewed_clocks,
    find_unknown_statuses,
    find_unreadable_payloads,
)
from agents.protocol.readings import Ages
from agents.protocol.rounds.area_round import AreaRound, Outcome
from agents.protocol.scan_end import ScanEnd
from agents.strategies.interface import Estimate
from dsse_core.estimation.decision import STEPS_USED_UP, Totals
from dsse_core.estimation.decision import UNOBSERVABLE as NOT_OBSERVABLE
from dsse_core.estimation.residuals import FALSE_ALARMS, chi_square_limit, describe_tap, find_switches, find_taps
from dsse_core.exchange.area_estimation import FAILURES
from dsse_core.grid.boundary import Kind
from dsse_core.grid.nodes import name_node
from dsse_core.split_identity import SplitUse

MISMATCH = 1e-6  # p.u. and rad, between the final voltages of the two sides of a boundary; rounding leaves 1e-8


class RoundsState:
    """The state as last published, with its estimate, outcome and readings."""

    def __init__(
        self,
        content: Configuration,
        peers: PeerTable,
        round: AreaRound,
        scan: ScanReadings,
        rejections: Rejections,
        splits: Splits,
        published: PublishedState,
        end: ScanEnd,
    ) -> None:
        self._area = content.area
        self._peers = peers
        self._round = round
        self._scan = scan
        self._rejections = rejections
        self._splits = splits
        self._published = published
        self._end = end
        self._limits = EstimateLimits(content.limits, content.area.network, content.meters)
        self._estimate: Estimate | None = None
        self._outcome: Outcome | None = None  # of the estimate
        self._of_scan = 0
        self._ages = Ages()  # of the readings of the estimate
        self._most_overdue = content.limits.most_overdue
        self._leader = content.readings.leader
        self._gateways = GatewayWatch(content.area)
        self._findings: tuple[Finding, ...] = ()  # of the outcome
        self._kept_mismatches: dict[
            str, tuple[Outcome, tuple[float, ...], tuple[float, float]]
        ] = {}  # as _find_mismatch found them

    def show(self, term: Term, now: float, *, is_heartbeat: bool) -> StateMessage | None:
        """Returns the state to be published at time ``now``, or None; passing notes alone wait for the heartbeat."""
        outcome = self._round.outcome
        is_new = outcome is not None and outcome is not self._outcome
        if outcome is not None and is_new:
            self._outcome, self._of_scan, self._ages = outcome, term[0], self._scan.readings.ages
            self._estimate, self._findings = self._read(outcome)
            if not self._scan.stale:
                has_end = self._estimate is not None and not outcome.verdict.reason
                known = self._round.estimation.before_removal if has_end else None  # no success, no evidence
                estimation, readings = self._round.estimation, self._scan.readings
                self._gateways.weigh(term[0], estimation.area, readings, known, is_fed=not estimation.dead.any())
        elif not is_heartbeat and self._is_first_way_through(term):
            return None
        is_end = self._outcome is not None and self._outcome is self._round.outcome
        findings, old_sides = [*self._findings, *self._passing_findings(term, now)], self._old_sides(term, now)
        self._end.note(term, self._estimate, findings, now, is_end=is_end, is_heartbeat=is_heartbeat)
        assessment, scan = assess(findings), self._of_scan or term[0]
        if not (is_new or is_heartbeat) and self._published.is_as_shown(assessment.quality, old_sides):
            return None
        return self._published.compose(self._estimate_now(term), assessment, old_sides, scan, now, self._ages)

    def show_end(self, term: Term, now: float) -> StateMessage | None:
        """Returns the state at an end of ``term`` that has not been shown yet: the next term begins at once."""
        is_new = self._round.outcome is not None and self._round.outcome is not self._outcome
        return self.show(term, now, is_heartbeat=False) if is_new else None

    def _is_first_way_through(self, term: Term) -> bool:
        """True where a scan is under way: in its first revision, or before the first published state.

        Until its estimate is there, only heartbeats publish a state: the notes of the last scan still hold of that.
        """
        if self._round.outcome is not None:
            return False
        return 0 < term[0] != self._of_scan and (not term[1] or self._published.message is None)

    def _read(self, outcome: Outcome) -> tuple[Estimate | None, tuple[Finding, ...]]:
        """Returns the estimate at the end of a term, and the findings that hold until the next end."""
        estimation, estimate = self._round.estimation, None
        self._published.closed = estimation.area.network.switches
        if not estimation.failure and outcome.verdict.reason != NOT_OBSERVABLE:
            try:
                estimate = self._read_estimate(outcome)
            except FAILURES as error:
                estimation.fail(error)
        findings = [*self._findings_of(outcome)]
        if estimation.failure and outcome.verdict.reason != NOT_OBSERVABLE:
            findings.insert(0, Finding(NONE, f"no estimate: {estimation.failure}", "no estimate"))
        if estimate is not None:
            findings += self._limits.find_breaches(estimate)
        return estimate, tuple(findings)

    def describe_readings(self) -> Mapping[str, tuple[float, float]]:
        """See ``AreaEstimation.describe_readings``; of the estimate that is shown, empty without one."""
        return self._round.estimation.describe_readings() if self._estimate is not None else {}

    def _read_estimate(self, outcome: Outcome) -> Estimate:
        estimation = self._round.estimation
        sigma_vm, sigma_va, critical = estimation.find_sigmas()
        estimation.weigh_switches()
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
            undecided=self._round.undecided,
            into_children=estimation.into_children,
            dead=tuple(estimation.dead.nonzero()[0].tolist()),
            taps=estimation.taps,
        )
        if not estimate.is_reasonable(estimation.no_load_va):
            raise ArithmeticError("the estimate is beyond reason")
        return estimate

    def _counts_all(self, outcome: Outcome) -> bool:
        """True where the iteration has succeeded, and its verdict rests on every area of the grid."""
        totals = outcome.totals
        return totals.areas == self._area.n_areas and not totals.silent and not outcome.verdict.reason

    def _findings_of(self, outcome: Outcome) -> Iterator[Finding]:
        """Yields findings on the estimate and the readings from the end of a term."""
        totals = outcome.totals
        yield from self._findings_of_end(outcome)
        yield from find_dead_sections(self._round.estimation.dead_places, totals.energised, totals.dark)
        yield from find_doubtful_switches(find_switches(self._round.removed), self._round.estimation.gains)
        if not totals.referenced:
            yield Finding(RELATIVE_ANGLE, "no area that is counted sees the substation or has an angle meter")
        for n in self._area.neighbours:
            if n.area in self._peers.distrusted:
                why = self._peers.distrusted[n.area]
                yield Finding(DEGRADED, f"{n.area} is not believed: {why}", "is not believed", [n.area])
            elif n.area not in self._round.links:
                yield Finding(DEGRADED, f"no information from {n.area}")
        if others := [name for name in totals.stale if name != self._area.name]:
            yield Finding(DEGRADED, f"no readings of this scan in {', '.join(others)}", "no readings in", others)
        elif totals.stale:
            yield Finding(DEGRADED, "this area counts as one without readings of this scan")
        if totals.areas > self._area.n_areas:
            senders = " or ".join([self._round.towards_hub] if self._round.towards_hub else self._round.lower)
            what = f"{totals.areas} of {self._area.n_areas} areas are counted"
            yield Finding(DEGRADED, f"{what}: {senders} says false things, or passes them on", "too many areas")
        elif totals.areas != self._area.n_areas:
            what = f"{totals.areas} of {self._area.n_areas} areas are counted"
            yield Finding(DEGRADED, what, "areas are not counted")
        elif totals.silent:
            silent = totals.silent
            yield Finding(DEGRADED, f"not received by a neighbour: {', '.join(silent)}", "not received", silent)

    def _findings_of_end(self, outcome: Outcome) -> Iterator[Finding]:
        """Yields a finding where the iteration has ended without success, or with contradictory readings."""
        totals, reason = outcome.totals, outcome.verdict.reason
        if reason == NOT_OBSERVABLE:
            dead = self._round.estimation.dead_voltmeters
            left_out = f"; left out as dead: {', '.join(dead)}" if dead else ""
            buses = ", ".join(totals.unobservable)
            what = f"not observable: no reading of this scan determines buses {buses}{left_out}"
            yield Finding(UNOBSERVABLE, what, "not observable", totals.unobservable)
        elif totals.failed:
            yield Finding(DEGRADED, f"no estimate in {', '.join(totals.failed)}", "no estimate in", totals.failed)
        elif reason == STEPS_USED_UP:
            what = "bad data are looked for no longer"
            yield Finding(DEGRADED, f"{what} ({reason}); J is still {totals.objective:.4g}", what)
        elif reason:
            what = "the iteration has not converged"
            off = f"the readings of this area are {self._round.estimation.deviation:.3g} standard deviations off"
            yield Finding(DEGRADED, f"{what} ({reason}); {off}, root mean square", what)
        elif kept := self._round.kept:
            yield Finding(
                DEGRADED,
                f"readings contradict each other (J {totals.objective:.4g} with {totals.degrees_of_freedom} degrees of "
                f"freedom); {kept} stands out, and stays because without it the iteration does not converge",
                "readings contradict each other",
                [kept],
            )
        elif _exceeds_limit(totals):
            taps = find_taps(dict(totals.worst))
            why = "; ".join(describe_tap(*tap) for tap in taps.items())
            yield Finding(
                DEGRADED,
                f"readings contradict each other (J {totals.objective:.4g} with {totals.degrees_of_freedom} degrees of "
                f"freedom){f'; {why}' if why else ', and no meter stands out that can be spared'}",
                "readings contradict each other",
                [f"tap of {branch}" for branch in taps],
            )

    def _passing_findings(self, term: Term, now: float) -> Iterator[Finding]:
        """Yields the findings that hold now, and may not hold at the next moment."""
        if self._outcome is None:
            is_waiting = not self._scan.has_been_read and not term[0]
            yield Finding(NONE, "no telemetry yet" if is_waiting else "the first estimate is under way")
        for name, note in self._mismatches(term):
            yield Finding(DEGRADED, note, "boundary mismatch", [name])
        if self._outcome is not None:
            yield from self._aging(term, now)
        for name, leave_reason in sorted(self._peers.gone.items()):
            yield find_gone(name, leave_reason)
        yield from find_rejected_clocks(self._rejections.ahead)
        yield from find_other_splits(self._splits.add_to(self._uses), self._area.name)
        yield from find_next_split(self._outcome.totals if self._outcome else Totals(), self._splits.edited_next)
        yield from find_contradictions(self._rejections.contradictions)
        yield from find_far_scans(self._rejections.far_scans)
        yield from find_unreadable_payloads(self._rejections.unreadable_in(self._scan.scan))
        yield from find_skewed_clocks(self._peers.skewed)
        yield from find_mistaken_gateways(self._gateways.mistaken)
        yield from find_leader_clock(self._leader, self._scan.leader_ahead_s)
        yield from find_early_scan(self._scan.lead_s)
        if self._scan.has_been_read:
            yield from find_missing_readings(self._scan.readings.unread, self._scan.readings.invalid)
            yield from find_left_out_readings(self._scan.readings)
        yield from find_meters_off(self._published.ordered.meters_off)
        yield from find_unknown_statuses(self._scan.store.statuses.unknown)

    def _aging(self, term: Term, now: float) -> Iterator[Finding]:
        """Yields findings on data that have grown old since the outcome, or are being replaced."""
        if self._scan.is_late(now):
            yield Finding(STALE, "telemetry is not received")
        yield from find_overdue_readings(self._ages, self._most_overdue, now)
        if self._scan.stale:
            stands_in = "the last ones stand in" if self._ages.times else "the last ones are too old to stand in"
            yield Finding(STALE, f"no readings of this scan; {stands_in}")
        if self._scan.are_outdated:
            yield Finding(DEGRADED, "other readings of this scan wait for the next term")
        if self._outcome is not self._round.outcome:
            what = "a newer estimate is under way"
            yield Finding(DEGRADED, f"a newer estimate, of scan {term[0]}, is under way", what)
            return
        for name in sorted(self._peers.find_old(term, self._round.links, now) - self._peers.gone.keys()):
            peer = self._peers[name]
            if name not in self._round.links:
                yield Finding(DEGRADED, f"no information from {name}")
            elif peer.term != term or not peer.final:
                yield Finding(DEGRADED, f"{name} has not come to the end of this term")
            elif not peer.complete:
                yield find_missing_side(name)
            else:
                yield Finding(DEGRADED, f"{name} is not received, or does not receive this area")

    def _mismatches(self, term: Term) -> Iterator[tuple[str, str]]:
        """Yields each neighbour whose final voltage at the boundary differs from that of this area, with the difference
        in words.

        Rounding leaves less, and without false messages both sides take the same steps. So an area on one of the two
        sides has sent false messages.
        """
        outcome, estimation = self._round.outcome, self._round.estimation
        if outcome is None or outcome.verdict.reason or estimation.failure:
            return
        for name, peer in sorted(self._peers.items()):
            if peer.term != term or not peer.final or not peer.y or name not in self._round.links:
                continue
            dvm, dva = self._find_mismatch(name, outcome, peer.y)
            if max(dvm, dva) > MISMATCH:
                met = ", ".join(name_node(*place) for place in self._area.boundaries[name].phases.items())
                yield (
                    name,
                    f"boundary mismatch with {name} at bus {met}: its final voltage differs by {dvm:.3g} p.u. and "
                    f"{math.degrees(dva):.3g} deg; one of the two sides says false things",
                )

    def _find_mismatch(self, name: str, outcome: Outcome, theirs: tuple[float, ...]) -> tuple[float, float]:
        """Returns the largest differences of (vm, va) at a boundary, p.u. and rad; called often, computed once."""
        kept = self._kept_mismatches.get(name)
        if kept is None or kept[0] is not outcome or kept[1] != theirs:
            own, places = self._round.estimation.boundary_values(name), self._area.boundaries[name].places
            vm = [abs(own[k] - theirs[k]) for k in places[Kind.VM]]
            va = [abs(math.remainder(own[k] - theirs[k], 2 * math.pi)) for k in places[Kind.VA]]
            mismatch = max(vm), max(va)
            self._kept_mismatches[name] = kept = outcome, theirs, mismatch
        return kept[2]

    def is_side_complete(self, name: str, term: Term, now: float) -> bool:
        """True where all on this side of neighbour ``name`` is received, fresh, at the end of this term and agrees."""
        outcome = self._round.outcome
        if outcome is None or self._scan.is_late(now, PASSED_ON_HEARTBEATS) or self._scan.are_outdated:
            return False
        if not self._counts_all(outcome) or any(self._mismatches(term)):
            return False
        if self._scan.readings.ages.overdue_share(now) > self._most_overdue or self._peers.skewed:
            return False
        if self._gateways.mistaken:
            return False
        if not self._splits.are_one(self._uses):
            return False
        return not self._peers.find_old(term, self._round.links, now, PASSED_ON_HEARTBEATS) - {name}

    @property
    def _uses(self) -> tuple[SplitUse, ...]:
        """The splits of the areas of the outcome."""
        return self._outcome.totals.splits if self._outcome is not None else ()

    def _old_sides(self, term: Term, now: float) -> tuple[str, ...]:
        """Returns the neighbours whose newest message does not state a complete side."""
        old = self._peers.find_old(term, self._round.links, now)
        return tuple(sorted(name for name in old if not self._peers[name].complete))

    def _estimate_now(self, term: Term) -> Estimate | None:
        """Returns the estimate, which counts as unchecked as long as a neighbour contradicts it."""
        if self._estimate is None or not any(self._mismatches(term)):
            return self._estimate
        return replace(self._estimate, checked=False)


def _exceeds_limit(totals: Totals) -> bool:
    """True where J at the end exceeds the limit that noise alone exceeds in the share FALSE_ALARMS of all scans."""
    return totals.objective >= chi_square_limit(totals.degrees_of_freedom, 1 - FALSE_ALARMS)
