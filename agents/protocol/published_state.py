"""The state message of an area: composed when it is published, with a new number when its content is new."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from agents.messages.packing import Header, StateMessage, content_of
from agents.peers.peer_table import PeerTable
from agents.peers.rejections import Rejections
from agents.peers.splits import Splits
from agents.protocol.events import Ordered
from agents.protocol.numbering import ScanReadings
from agents.protocol.quality import Assessment
from agents.protocol.readings import Ages
from agents.strategies.interface import Estimate
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Area
from dsse_core.grid.switches import name_statuses

EMPTY = "buses", "vm", "va", "sigma_vm", "sigma_va", "removed", "critical", "into_children", "phases"  # no estimate


class PublishedState:
    """``message``: the state as last published, None before the first. ``ordered``: the last command of the operator.
    ``closed``: switch of the area -> True where it is closed in the estimate.

    Args:
        header_for: the header of the message with that sequence number.
    """

    def __init__(
        self,
        area: Area,
        peers: PeerTable,
        scan: ScanReadings,
        rejections: Rejections,
        splits: Splits,
        header_for: Callable[[int], Header],
    ) -> None:
        self.message: StateMessage | None = None
        self.ordered = Ordered((0, 0, 0), ())
        self.closed: Mapping[str, bool] = area.network.switches
        self._network = area.network
        self._peers = peers
        self._scan = scan
        self._rejections = rejections
        self._splits = splits
        self._header_for = header_for
        self._described: tuple[Estimate | None, dict[str, Any]] = (
            None,
            describe_estimate(None, area.network),
        )  # the last one
        self._standing: object = None  # a change of it publishes a state with the same estimate

    def is_as_shown(self, quality: str, old_sides: tuple[str, ...]) -> bool:
        """True where the last state is right as of now, apart from the estimate and the notes of the strategy.

        Fewer old sides alone are no reason to publish: the state waits for a new quality, or for the heartbeat.
        """
        shown = self.message.old_sides if self.message else ()
        return self._standing == self._find_standing(quality) and set(old_sides) <= set(shown)

    def _find_standing(self, quality: str) -> object:
        r = self._rejections
        rejections = set(r.ahead), dict(r.contradictions), dict(r.far_scans), set(self._peers.skewed)
        return quality, dict(self._peers.gone), rejections, self.ordered, dict(self._splits.others)

    def compose(
        self,
        estimate: Estimate | None,
        assessment: Assessment,
        old_sides: tuple[str, ...],
        scan: int,
        now: float,
        ages: Ages,
    ) -> StateMessage:
        """Returns the state of ``scan`` at time ``now``, without the counts of the links.

        ``ages``: of the readings that ``estimate`` rests on.

        States of one sequence number differ only in fields that ``content_of`` leaves out.
        """
        peers, last = sorted(self._peers.items()), self.message
        state = StateMessage(
            header=replace(self._header_for(last.header.sequence + 1 if last else 1), scan=scan),
            **self._describe(estimate),
            sent={name: (peer.load.sequence, peer.exchange.sequence) for name, peer in peers},
            received={name: peer.received for name, peer in peers},
            messages=0,
            bytes=0,
            lost=0,
            notes=assessment.notes,
            faults={},
            quality=assessment.quality,
            telemetry_age=self._scan.age(now),
            ages={name: now - peer.received_at for name, peer in peers if peer.received_at > -math.inf},
            scans={name: peer.term[0] for name, peer in peers if peer.incarnation is not None},
            old_sides=old_sides,
            rejected=dict(Counter(self._rejections.counts) + self._scan.rejected),
            clock_skews=self._peers.clock_skews(),
            taken_at=ages.taken_at,
            oldest_reading=max(ages.oldest_s, self._scan.age(now)),
            meters_off=self.ordered.meters_off,
            command=self.ordered.order,
            split=self._splits.own,
            next_split=self._splits.held,
            switches=name_statuses(self.closed),
        )
        if last is not None and content_of(last) == content_of(state) and last.header.scan == scan:
            state = replace(state, header=replace(state.header, sequence=last.header.sequence))
        self.message, self._standing = state, self._find_standing(assessment.quality)
        return state

    def _describe(self, estimate: Estimate | None) -> dict[str, Any]:
        """See ``describe_estimate``; called once for an estimate, which every heartbeat repeats."""
        if self._described[0] is not estimate:
            self._described = estimate, describe_estimate(estimate, self._network)
        return self._described[1]


def describe_estimate(estimate: Estimate | None, network: Network) -> dict[str, Any]:
    """Returns the fields of a state that ``estimate`` of ``network`` fills; all are empty without an estimate."""
    if estimate is None:
        empty: dict[str, Any] = dict.fromkeys(EMPTY, ())
        return empty | {"referenced": False, "objective": 0.0, "degrees_of_freedom": 0, "checked": False, "taps": {}}
    vm, va, dead = estimate.vm.copy(), estimate.va.copy(), list(estimate.dead)
    vm[dead] = va[dead] = 0.0
    return {
        "buses": network.node_buses,
        "phases": network.node_phases,
        "vm": tuple(vm.tolist()),
        "va": tuple(va.tolist()),
        "sigma_vm": tuple(estimate.sigma_vm.tolist()),
        "sigma_va": tuple(estimate.sigma_va.tolist()),
        "referenced": estimate.referenced,
        "objective": estimate.objective,
        "degrees_of_freedom": estimate.degrees_of_freedom,
        "removed": estimate.removed,
        "critical": estimate.critical,
        "checked": estimate.checked,
        "into_children": estimate.into_children,
        "taps": dict(estimate.taps),
    }
