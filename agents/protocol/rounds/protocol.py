"""Strategy ``information``, one area's protocol in rounds: the areas together take the centralised estimate's steps.

The areas form a tree, and each knows which neighbour lies towards the hub. In round k an area waits for Up(k) of all
other neighbours, adds its own information, and sends Up(k) on. The area with no neighbour towards the hub has the
totals of all areas, and decides. Down(k) carries the totals and the information of all other areas back. An area that
receives Down(k) takes the step, passes Down(k) on and is in round k + 1. Every message states its (scan, revision, k),
so that messages of different iterations never meet.

A *term* is (scan, revision). The links in use are fixed when an area enters a term. A change of links (a neighbour is
silent, back, or has restarted), late or new readings of the scan, a command of the operator or a neighbour that is not
believed raise the revision. Then all areas begin again at round 0 with the state so far.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from agents.messages.boundary_arrays import write_triangle
from agents.messages.packing import (
    DownMessage,
    HeartbeatMessage,
    Incarnation,
    LinkMessage,
    Message,
    StateMessage,
    TelemetryMessage,
    UpMessage,
)
from agents.peers.peers import Peer, Term
from agents.peers.rejections import BEYOND, FAR_SCAN, MOST_COUNTED
from agents.protocol.area_protocol import AreaProtocol
from agents.protocol.configuration import Configuration
from agents.protocol.events import Action, Publish
from agents.protocol.numbering import MOST_AHEAD, TelemetryUpdate
from agents.protocol.rounds.area_round import AreaRound, Decider, Outcome, RoundContent
from agents.protocol.rounds.state import RoundsState
from agents.strategies.interface import AnyStrategy
from dsse_core.estimation.decision import Totals

RoundsMessage = HeartbeatMessage | UpMessage | DownMessage


class RoundsProtocol(AreaProtocol, AnyStrategy):
    """One area's part in rounds; for the arguments see ``AreaProtocol``."""

    message_types = (UpMessage, DownMessage)
    takes_rings = True
    why_no_phases = ""

    def __init__(self, content: Configuration, incarnation: Incarnation, *, now: float, started_at: float) -> None:
        super().__init__(content, self.kinds(), incarnation, now=now, started_at=started_at)
        self.round = AreaRound(content.area, self._splits)
        self._revision = 0
        self._is_change_due = False
        self._has_loads_to_send = False  # loads only stand in for missing information
        self._raised_at = -math.inf  # when this area itself last raised the revision
        known = self._peers, self.round, self._scan, self._rejections, self._splits
        self._state = RoundsState(content, *known, self._published, self._end)

    def describe_backend(self) -> str:
        """Returns, for the log, the back end that computes, and how often another had to."""
        return self.round.estimation.describe_backend()

    @property
    def term(self) -> Term:
        """(scan, revision)."""
        return self._scan.scan, self._revision

    @property
    def outcome(self) -> Outcome | None:
        """End of the present term; None before."""
        return self.round.outcome

    @property
    def removed(self) -> tuple[str, ...]:
        """The meters of all areas that this term has taken out as bad data, in order."""
        return self.round.removed

    @property
    def _term(self) -> Term:
        return self.term

    @property
    def _is_at_rest(self) -> bool:
        return self.round.outcome is not None or self.scan == 0

    def _due_times(self) -> Iterator[float]:
        yield from super()._due_times()
        yield self._scan.deadline
        if self._is_change_due:
            yield self._raised_at + self._heartbeat_s
        elif not self._is_at_rest:
            yield from map(self._peers.absent_at, self.round.links)

    # Incoming messages

    def _find_rejection(self, message: Message) -> str:
        if not isinstance(message, RoundsMessage):
            return ""
        if not self._scan.may_enter(message.header.scan, self._now):
            return FAR_SCAN
        # beyond half of what is accepted only in small steps: the revision that follows a lie is accepted, too
        return BEYOND if message.revision > max(MOST_COUNTED // 2, self._revision + MOST_AHEAD) else ""

    def _take_numbering(self, name: str, message: HeartbeatMessage) -> Iterator[Action]:
        yield from self._act_on(self._scan.take_numbering(name, message.plant, message.offset, self._now))

    def _take_telemetry(self, message: TelemetryMessage) -> Iterator[Action]:
        yield from self._act_on(self._scan.take(message, self._now))

    def _take_readings_anew(self) -> Iterator[Action]:
        yield from self._change()

    def _act_on(self, update: TelemetryUpdate) -> Iterator[Action]:
        """Uses new readings, or readings that belong to another scan than assumed before."""
        match update:
            case TelemetryUpdate.NEXT_SCAN:
                yield from self._enter_next_scan()
            case TelemetryUpdate.AWAITED:
                yield from self._begin()
            case TelemetryUpdate.LATE:
                yield from self._change()

    def _take_load(self) -> Iterator[Action]:
        self._has_loads_to_send |= self._scan.are_there
        yield from ()

    def _receive(self, name: str, message: LinkMessage) -> Iterator[Action]:
        assert isinstance(message, RoundsMessage)
        peer = self._peers[name]
        is_restart = self._note(name, message)
        yield from self._send_if_lacking(name, peer.load, message.received[0])
        term = (message.header.scan, message.revision)
        if term[0] > self.scan:
            peer.take_reply(peer.exchange)  # the neighbour has moved on, and lacks no message
            if self._owes_final():
                return
        if term > self.term:
            yield from self._enter(term)
        elif self.scan and name not in self._peers.distrusted and self._must_change_for(name, message, is_restart):
            yield from self._change()
        if term < self.term:
            # a message that is being repeated shows our term as well, but not how scans are numbered
            peer.is_owed_reply |= peer.exchange.repeat is None or term[0] < self.scan
        elif name in self.round.links:
            yield from self._take_in_term(name, peer, message)

    def _must_change_for(self, name: str, message: RoundsMessage, is_restart: bool) -> bool:
        """True where a neighbour outside the links in use is back, or a neighbour has restarted."""
        return is_restart or (name not in self.round.links and message.receives)

    def _take_in_term(self, name: str, peer: Peer, message: RoundsMessage) -> Iterator[Action]:
        if isinstance(message, HeartbeatMessage):
            if why := self.round.find_other_end(message.k, message.final):
                yield from self._distrust(name, why)
            else:
                yield from self._send_if_lacking(name, peer.exchange, message.received[1])
        elif not self._is_change_due and isinstance(message, DownMessage) == (name == self._area.towards_hub):
            yield from self._take_round(name, peer, message)

    def _take_round(self, name: str, peer: Peer, message: UpMessage | DownMessage) -> Iterator[Action]:
        """Takes in a message of a round from a neighbour in use, and answers or acknowledges it at once."""
        if message.k > self.round.k:
            return  # sent to a former incarnation of this area
        peer.is_owed_reply = True
        peer.take_number(message.header.sequence, self._now)
        if message.k < self.round.k:
            if peer.has_waited_for_trip(self._now):  # the neighbour lacks the answer of this area
                yield from self._send_if_lacking(name, peer.exchange, message.received[1], even_if_repeated=True)
        elif isinstance(message, UpMessage):
            if why := self.round.find_false_count(message):
                yield from self._distrust(name, why)
            elif self.round.take_up(name, message):
                peer.take_reply(peer.exchange)
                yield from self._go_on()
        elif self.round.is_waited_for():
            peer.take_reply(peer.exchange)
            yield from self._take_down(name, message)

    # Terms

    def _owes_final(self) -> bool:
        """True where a present neighbour may lack the final message of this scan.

        It would never get this message from an area that has left the scan.
        """
        if self.round.outcome is None:
            return False
        lower = self.round.lower
        unacknowledged = (name for name in lower if self._peers[name].exchange.repeat is not None)
        return any(self._peers.is_present(name, self._now) for name in unacknowledged)

    def _enter_next_scan(self) -> Iterator[Action]:
        """Leaves this scan, at its end, for a later one with readings. The end comes without silent neighbours."""
        if self._scan.next_scan and self._is_at_rest and not self._owes_final():
            yield from self._enter((self._scan.next_scan, 0))

    def _change(self) -> Iterator[Action]:
        """Enters the next revision; an area raises the revision itself at most once per heartbeat interval."""
        if self._now < self._raised_at + self._heartbeat_s:
            self._is_change_due = True
            return
        self._raised_at = self._now
        yield from self._enter((self.scan, self._revision + 1))

    def _enter(self, term: Term) -> Iterator[Action]:
        """Shows the end of the former term and drops it; begins ``term`` with all present neighbours not distrusted."""
        if self.round.outcome is not None:
            yield from self._publish_state(self._state.show_end(self.term, self._now))
            yield from self._show_readings()
            if term[0] > self.scan and self._all_hold_next():
                yield from self._go_over()
        scan, self._revision = term
        if scan != self.scan:
            self._peers.distrusted = {}
        self._is_change_due = False
        self._scan.enter(scan, self._now)
        self._rejections.note_scan(scan)
        self._peers.begin_term()
        self.round.enter(self._peers.present(self._now))
        if self._scan.are_there:
            yield from self._begin()

    @property
    def _may_go_over(self) -> bool:
        return not self._owes_final()

    def _all_hold_next(self) -> bool:
        """True where this term has ended for all areas, and all of them hold the file of the next split.

        Where the next split has fewer areas, the areas left out are stopped first; where it has more, the new ones
        wait.
        """
        outcome, following = self.round.outcome, self._next
        if outcome is None or following is None or outcome.verdict.next_split != self._splits.held.digest:
            return False
        return outcome.totals.areas >= min(self._area.n_areas, following.area.n_areas)

    def _begin(self) -> Iterator[Action]:
        """Begins round 0 with the readings."""
        self._has_loads_to_send = True
        loads = self._received_loads()
        closed = self._scan.store.statuses.closed
        self.round.begin(self._scan.readings.measurements, stale=self._scan.stale, loads=loads, closed=closed)
        yield from self._go_on()

    # Rounds

    def _go_on(self) -> Iterator[Action]:
        """Sends Up(k) as soon as all neighbours farther from the hub have, or decides where none lies towards it.

        An area without links decides round by round until the end.
        """
        while self.round.may_go_on and not self._is_change_due:
            totals = self.round.add_up()
            if name := self.round.towards_hub:
                yield self._send_round(
                    name, UpMessage(**self._fields_of(name, self.round.find_up(totals), self.round.k))
                )
                return
            incarnation = (self._incarnation.start_ms, self._incarnation.random)
            yield from self._descend(totals, Decider(self._area.name, incarnation), None)
        self.round.prepare()

    def _take_down(self, name: str, message: DownMessage) -> Iterator[Action]:
        """Follows Down(k), unless it contradicts itself or Up(k): then goes on without its sender in this scan."""
        if why := self.round.find_lie(message):
            yield from self._distrust(name, why)
            return
        yield from self._descend(message.totals, Decider(message.decider, message.incarnation), message)
        yield from self._go_on()

    def _distrust(self, name: str, why: str) -> Iterator[Action]:
        """Goes on without a neighbour in this scan: its messages contradict themselves, the grid or sent ones."""
        self._peers.distrusted[name] = why
        yield from self._change()

    def _descend(self, totals: Totals, decider: Decider, down: DownMessage | None) -> Iterator[Action]:
        """Decides on the totals of all areas, for itself or after ``decider``; passes totals and verdict on."""
        verdict, k = self.round.decide(totals), self.round.k
        for name, content in self.round.descend(verdict, totals, decider, down):
            fields = self._fields_of(name, content, k)
            message = DownMessage(**fields, verdict=str(verdict), decider=decider.name, incarnation=decider.incarnation)
            yield self._send_round(name, message)
        if self.round.outcome is not None:
            yield from self._enter_next_scan()

    # Outgoing messages

    def _fields_of(self, name: str, content: RoundContent, k: int) -> dict[str, Any]:
        """Returns the fields of a message of round ``k``; the state of the link is filled in as it is sent."""
        peer, information, no_load = self._peers[name], content.information, content.no_load
        return {
            "header": self._header(peer.exchange.sequence + 1),
            "variables": self._area.boundaries[name].names,
            "revision": self._revision,
            "k": k,
            "receives": False,
            "answers": 0.0,
            "received": (0, 0),
            "R": write_triangle(information.R) if information else (),
            "z": tuple((information.z * information.R.any(axis=1)).tolist()) if information else (),
            "no_load": write_triangle(no_load.R) if no_load else (),
            "power": content.power,
            "totals": content.totals,
            "pieces": content.pieces,
        }

    def _send_round(self, name: str, message: UpMessage | DownMessage) -> Publish:
        return self._send(name, self._peers[name].exchange, message)

    def _describe_standing(self, name: str) -> dict[str, Any]:
        outcome, estimation = self.round.outcome, self.round.estimation
        has_y = outcome is not None and name in self.round.links and not estimation.failure
        y = estimation.boundary_values(name) if has_y else ()
        return {"revision": self._revision, "k": self.round.k, "final": outcome is not None, "y": y}

    def _is_side_complete(self, name: str) -> bool:
        return self._state.is_side_complete(name, self.term, self._now)

    # Time

    def _act(self, *, is_heartbeat: bool) -> Iterator[Action]:
        if self._now >= self._scan.deadline:
            self._scan.go_on_without(self._now)
            yield from self._begin()
        is_anyone_absent = any(not self._peers.is_present(name, self._now) for name in self.round.links)
        if self._is_change_due or (is_anyone_absent and not self._is_at_rest):
            yield from self._change()
        yield from self._enter_next_scan()

    def _show(self, *, is_heartbeat: bool) -> Iterator[Publish]:
        """Yields the state once a scan at rest, again at every heartbeat, and when its quality changes.

        Load messages come last, as no neighbour waits for them. After the first ones they come with the heartbeat.
        """
        yield from self._publish_state(self._state.show(self.term, self._now, is_heartbeat=is_heartbeat))
        is_first = any(peer.load.message is None for _, peer in self._peers.items())
        if self._has_loads_to_send and (is_heartbeat or is_first):
            self._has_loads_to_send = False
            yield from self._send_loads()

    @property
    def _may_show_readings(self) -> bool:
        return self.round.outcome is not None

    def _describe_readings(self) -> Mapping[str, tuple[float, float]]:
        return self._state.describe_readings()

    def _publish_state(self, state: StateMessage | None) -> Iterator[Publish]:
        if state is not None:
            yield Publish(state, None)
