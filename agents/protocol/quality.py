"""Quality of a published state, with its reasons. docs/explanation/quality.md states the promise of each quality.

Every note on an estimate is a ``Finding``: a sentence, and the best quality that it leaves. The quality of a state is
the worst of its findings, and its notes are their sentences, the worst first. So neither can be without the other: a
state that is not good has a note with the reason, and a state without such a note is good.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from agents.messages.checks import limit_notes
from agents.messages.packing import StateMessage
from agents.peers.clock_skew import Skew
from agents.protocol.readings import Ages, Readings
from agents.strategies.interface import Estimate
from dsse_core.estimation.decision import Totals
from dsse_core.estimation.state_limits import StateLimits
from dsse_core.estimation.switches import Gain, describe_switches
from dsse_core.grid.measurement import Meter, Source
from dsse_core.grid.network import Network
from dsse_core.reading_rules import LEAST_LEAD_S
from dsse_core.split_identity import SplitIdentity, SplitUse, are_of_one, describe_other, find_newest

GOOD, DEGRADED, RELATIVE_ANGLE, STALE, NONE = "good", "degraded", "relative-angle", "stale", "none"
UNOBSERVABLE = "unobservable"
QUALITIES = (GOOD, DEGRADED, RELATIVE_ANGLE, STALE, NONE, UNOBSERVABLE)  # from the best to the worst


class Finding(NamedTuple):
    """``note``: a sentence about an estimate. ``quality``: the best that it can be; good for a mere remark.

    ``about``: the note without figures and names, given where the note has these; ``whom``: the names.
    """

    quality: str
    note: str
    about: str = ""
    whom: Sequence[str] = ()


class Assessment(NamedTuple):
    """The ``quality`` of a state, and ``notes``: unless the state is good, the first one is the reason."""

    quality: str
    notes: tuple[str, ...]


def assess(findings: Iterable[Finding]) -> Assessment:
    """Returns the worst quality, and all notes, the worst first; equal notes are reported once."""
    ordered = sorted(findings, key=lambda finding: -QUALITIES.index(finding.quality))
    quality = ordered[0].quality if ordered else GOOD
    return Assessment(quality, limit_notes(tuple(dict.fromkeys(finding.note for finding in ordered))))


def assess_from_outside(state: StateMessage | None, silence: str, disputes: Sequence[str] = ()) -> Assessment:
    """Returns the quality of ``state``, the last one received from an area, as its receiver sees it.

    ``silence``: the reason why the area publishes no more, empty if it publishes; the state of a silent area is stale.
    ``disputes``: contradictions that other areas state, which the area itself may not know.
    """
    if state is None:
        return Assessment(NONE, (silence or "never received",))
    quality, notes = Assessment(state.quality, state.notes)
    if disputes:
        quality, notes = (
            DEGRADED if quality == GOOD else quality,
            (*disputes, *notes) if quality == GOOD else (*notes, *disputes),
        )
    if silence:
        quality, notes = quality if quality == NONE else STALE, (silence, *notes)
    return Assessment(quality, limit_notes(notes))


class EstimateLimits:
    """Limits that an estimate of an area must keep: voltages within ``limits``, most of ``meters`` in use."""

    def __init__(self, limits: StateLimits, network: Network, meters: Iterable[Meter]) -> None:
        self._limits = limits
        self._network, self._nodes = network, "nodes" if network.node_phases else "buses"
        self._n_meters = sum(meter.source is not Source.VIRTUAL for meter in meters)

    def find_breaches(self, estimate: Estimate) -> Iterator[Finding]:
        """Yields findings where ``estimate`` exceeds the limits, or the readings do not tell which meter is wrong."""
        limits, vm = self._limits, estimate.vm
        outside = np.flatnonzero((vm < limits.lowest_vm) | (vm > limits.highest_vm))
        if outside.size:
            worst = outside[np.argmax(abs(vm[outside] - (limits.lowest_vm + limits.highest_vm) / 2))]
            band = f"{limits.lowest_vm:g} to {limits.highest_vm:g} p.u."
            yield Finding(
                DEGRADED,
                f"voltages of {outside.size} {self._nodes} are outside {band}, the farthest is {vm[worst]:.3g} p.u. at "
                f"bus {self._network.node_names[worst]}",
                "voltages are outside",
            )
        if len(estimate.removed) > limits.most_removed * self._n_meters:
            yield Finding(
                DEGRADED,
                f"{len(estimate.removed)} of {self._n_meters} meters are removed, more than "
                f"{100 * limits.most_removed:g} %: which of them are wrong is not clear",
                "many meters are removed",
            )
        for removed, *others in estimate.undecided:
            yield Finding(
                DEGRADED,
                f"{removed} is removed, and the readings do not tell it from {', '.join(others)}: check which is wrong",
                "the readings do not tell which meter is wrong",
                [removed, *others],
            )


def find_missing_side(name: str) -> Finding:
    """Returns the finding that neighbour ``name`` does not state that all on its side is received and fresh."""
    return Finding(DEGRADED, f"behind {name} something is missing or old")


def find_gone(name: str, leave_reason: str) -> Finding:
    """Returns the finding that the process of a neighbour has ended."""
    return Finding(
        DEGRADED, f"neighbour {name} has left: {leave_reason}" if leave_reason else f"neighbour {name} is gone"
    )


def find_rejected_clocks(ahead: Mapping[str, float]) -> Iterator[Finding]:
    """Yields a finding for each sender rejected as from the future; its absence has a finding of its own.

    ``ahead``: sender, "" for the plant -> lead of its clock, s.
    """
    for name, lead in sorted(ahead.items()):
        yield Finding(
            GOOD,
            f"{name or 'telemetry'} is rejected, from {lead:.0f} s in the future: the clock of this area is behind, "
            "or that of the sender ahead; set it, then start its process again",
            "rejected, from the future",
            [name],
        )


def find_contradictions(contradictions: Mapping[str, str]) -> Iterator[Finding]:
    """Yields a finding for each neighbour that contradicts this area; its absence has a finding of its own.

    ``contradictions``: neighbour -> contradiction of its area file or strategy with this area, in words.
    """
    for name, what in sorted(contradictions.items()):
        yield Finding(DEGRADED, f"{name} is rejected: {what}")


def find_other_splits(uses: Sequence[SplitUse], own_name: str) -> Iterator[Finding]:
    """Yields findings for files not of the newest split of ``uses``, or edited since; ``own_name``: of this area."""
    newest, is_named = find_newest(uses), False
    for use in uses:
        if use.split == newest and newest.is_sound:
            continue
        for name in use.areas:
            is_named = True
            whose = "this area" if name == own_name else name
            yield Finding(DEGRADED, describe_other(whose, use.split, newest), "file of another split", [name])
    if not (is_named or are_of_one(uses)):
        known = ", ".join(str(use.split) for use in uses)
        yield Finding(DEGRADED, f"files on this run are of several splits: {known}", "files of several splits")


def find_next_split(totals: Totals, edited: SplitIdentity) -> Iterator[Finding]:
    """Yields findings for files of next splits that lie ready in some areas only, and ``edited``: an unusable file."""
    for split, count in totals.held:
        if count < totals.areas or len(totals.held) > 1:
            what = f"the file of the next {split} lies ready in {count} of {totals.areas} areas"
            yield Finding(GOOD, what, "file of the next split")
    yield from find_edited_next(edited)


def find_waiting_next(held: SplitIdentity, edited: SplitIdentity) -> Iterator[Finding]:
    """Yields findings, under a strategy without verdicts, for a next file: ``held``, usable, or ``edited``, not."""
    if held.digest:
        what = f"the file of the next {held} lies ready: the area takes it once a neighbour works on that split"
        yield Finding(GOOD, what, "file of the next split")
    yield from find_edited_next(edited)


def find_edited_next(edited: SplitIdentity) -> Iterator[Finding]:
    """Yields a finding for a file of the next split that was edited."""
    if edited.edited:
        yield Finding(GOOD, f"the file of the next {edited} cannot be used: replace it", "file of the next split")


def find_far_scans(far_scans: Mapping[str, int]) -> Iterator[Finding]:
    """Yields findings; ``far_scans``: neighbour -> the scan far ahead of the telemetry announced in its name."""
    for name, scan in sorted(far_scans.items()):
        yield Finding(
            GOOD,
            f"messages of {name} are rejected: one announced scan {scan}, far ahead of the telemetry; if its own state "
            f"shows none like it, another process sends in the name of {name}: use keys",
            "rejected, a scan far ahead",
            [name],
        )


def find_unreadable_payloads(unreadable: Mapping[str, str]) -> Iterator[Finding]:
    """Yields findings; ``unreadable``: neighbour or gateway -> fault of its payload that is no message."""
    for name, detail in sorted(unreadable.items()):
        yield Finding(GOOD, f"payloads of {name} are rejected, {detail}", "payloads are rejected", [name])


def find_skewed_clocks(skewed: Mapping[str, Skew]) -> Iterator[Finding]:
    """Yields a finding for each neighbour whose clock is too far from that of this area."""
    for name, skew in sorted(skewed.items()):
        where = "ahead of" if skew.ahead_s > 0 else "behind"
        yield Finding(
            DEGRADED,
            f"the clock of {name} is {abs(skew.ahead_s):.2g} s {where} that of this area; one of the two is wrong",
            f"clock {where}",
            [name],
        )


def find_overdue_readings(ages: Ages, most_overdue: float, now: float) -> Iterator[Finding]:
    """Yields findings for overdue readings (``KindRule.overdue_s``), and for the quality of an estimate from them."""
    if overdue := ages.find_overdue(now):
        yield Finding(GOOD, f"overdue: the reading of {_first_of(overdue)}", "overdue", overdue)
    share = ages.overdue_share(now)
    if share >= 1:
        yield Finding(STALE, "all readings of this area are overdue or missing")
    elif share > most_overdue:
        yield Finding(
            DEGRADED,
            f"{100 * share:.0f} % of the readings of this area are overdue or missing, more than "
            f"{100 * most_overdue:g} %",
            "many readings are overdue or missing",
        )


def find_early_scan(lead_s: float) -> Iterator[Finding]:
    """Yields a finding where the scan has begun ``LEAST_LEAD_S`` or more before its time by the area's clock."""
    if lead_s >= LEAST_LEAD_S:
        yield Finding(
            GOOD,
            "this scan is ahead of the clock of this area: that of a neighbour is ahead, or this one has been set back",
        )


def find_left_out_readings(readings: Readings) -> Iterator[Finding]:
    """Yields findings for meters whose newest reading is not used, with the reason."""
    if readings.too_old:
        yield Finding(GOOD, f"too old: the reading of {_first_of(readings.too_old)}", "too old", readings.too_old)
    by_reason: dict[tuple[str, str], list[str]] = {}
    for meter_id, reason in readings.why_rejected.items():
        if meter_id not in readings.invalid:  # which has a finding of its own
            quality = DEGRADED if meter_id in readings.mistimed else GOOD
            by_reason.setdefault((quality, reason), []).append(meter_id)
    for (quality, reason), meters in sorted(by_reason.items()):
        yield Finding(quality, f"{reason}: the newest reading of {_first_of(meters)}", reason, meters)


def find_mistaken_gateways(mistaken: Mapping[str, str]) -> Iterator[Finding]:
    """Yields findings; ``mistaken``: gateway whose power readings are wrong as a whole -> mistake, in words."""
    for gateway, words in sorted(mistaken.items()):
        yield Finding(
            DEGRADED,
            f"all power readings of gateway {gateway} look wrong, {words}: with them grid and loads do not fit, with "
            "that corrected they do; look at its map",
            "a gateway looks wrong",
            [gateway],
        )


def find_leader_clock(leader: str, ahead_s: float) -> Iterator[Finding]:
    """Yields a finding where the clock of the gateway that numbers scans is ``ahead_s`` ahead of the own one.

    The readings of this gateway are not of the present then.
    """
    if ahead_s:
        where = "ahead of" if ahead_s > 0 else "behind"
        yield Finding(
            DEGRADED,
            f"the clock of {leader} is {abs(ahead_s):.0f} s {where} that of this area; one of the two is wrong",
            f"clock {where}",
            [leader],
        )


def find_missing_readings(unread: Sequence[str], invalid: Sequence[str]) -> Iterator[Finding]:
    """Yields findings for meters without a usable reading; the standard deviations of the estimate show the effect."""
    if invalid:
        yield Finding(GOOD, f"marked invalid: the reading of {_first_of(invalid)}", "marked invalid", invalid)
    if unread:
        yield Finding(GOOD, f"no reading from {_first_of(unread)}", "no reading", unread)


def find_dead_sections(places: Sequence[str], energised: Sequence[str], opened: Sequence[str]) -> Iterator[Finding]:
    """Yields findings for ``places`` of this area without supply, and for voltmeters of any area that are ``energised``
    there; ``opened``: the open branches around all such places.
    """
    around = f"; open around: {', '.join(opened)}" if opened else ""
    if energised:
        what = f"{', '.join(energised)} read a voltage where there is no supply{around}; check these statuses"
        yield Finding(DEGRADED, what, "a voltage where there is no supply", energised)
    if places:
        yield Finding(GOOD, f"without supply: buses {', '.join(places)}{around}", "without supply", places)


def find_unknown_statuses(unknown: Mapping[str, str]) -> Iterator[Finding]:
    """Yields a finding for each switch of ``unknown`` status; the text is what is told of it."""
    for switch, told in sorted(unknown.items()):
        what = f"status of switch {switch} unknown: {told}; it stays as it was"
        yield Finding(DEGRADED, what, "status unknown", [switch])


def find_doubtful_switches(switched: Sequence[str], gains: Mapping[str, Gain]) -> Iterator[Finding]:
    """Yields findings for ``switched``: switches of any area that this scan takes the other way; and for switches of
    this area by ``gains``, see ``weigh_switches``.
    """
    for note in describe_switches(switched, {}):
        yield Finding(DEGRADED, note, "a switch counts the other way", switched)
    for note in describe_switches((), gains):
        yield Finding(GOOD, note, "status of switches", tuple(gains))


def find_meters_off(meters: Sequence[str]) -> Iterator[Finding]:
    """Yields a finding for the meters that the operator has switched off."""
    if meters:
        yield Finding(GOOD, f"switched off by the operator: {_first_of(meters)}", "switched off", meters)


def _first_of(meters: Sequence[str]) -> str:
    """Returns the id of the first meter, and the number of the others."""
    n = len(meters) - 1
    return f"{meters[0]} and {n} other{'s' if n > 1 else ''}" if n else meters[0]
