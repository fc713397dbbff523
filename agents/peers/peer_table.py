"""The neighbours of an area: who is there, what was last sent to whom, and what is due."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from agents.messages.packing import BoundaryUpdate, Header, HeartbeatMessage, LinkMessage
from agents.peers.clock_skew import ClockSkew, Skew
from agents.peers.freshness import FRESH_HEARTBEATS, PASSED_ON_HEARTBEATS
from agents.peers.peers import Peer, Term, term_of
from dsse_core.grid.partition import Neighbour

M = TypeVar("M", bound=LinkMessage)


class PeerTable:
    """``gone``: neighbours whose processes have ended -> their leave message. ``distrusted``: neighbour -> why its
    messages are not used in this scan. ``skewed``: neighbours whose clocks are too far from the own one.
    ``correction``: by how much the own clock is ahead of the own send times, s.

    Args:
        clock_offset: from monotonic to wall-clock time, s, as send times state it.
        skew_limit_s: by how much clocks may differ, s.
    """

    def __init__(
        self,
        neighbours: Sequence[Neighbour],
        heartbeat_s: float,
        now: float,
        clock_offset: float,
        skew_limit_s: float = math.inf,
    ) -> None:
        self.gone: dict[str, str] = {}
        self.distrusted: dict[str, str] = {}
        self._peers = {n.area: Peer(n.bus, now, now + clock_offset, heartbeat_s) for n in neighbours}
        self._heartbeat_s = heartbeat_s
        self.clock_offset = clock_offset
        self.correction = 0.0
        self.skewed: dict[str, Skew] = {}
        self._skew_limit_s = skew_limit_s

    def __getitem__(self, name: str) -> Peer:
        return self._peers[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._peers)

    def items(self) -> Iterator[tuple[str, Peer]]:
        yield from self._peers.items()

    def follow_clock(self, offset: float, now: float) -> None:
        """The own clock has been set, ``offset`` from monotonic time: send times go forward with it, never back."""
        if offset > self.clock_offset:
            self.clock_offset = offset
            for peer in self._peers.values():  # nothing that was sent before measures a round trip
                peer.since, peer.clock = now + offset, ClockSkew()
        self.correction = offset - self.clock_offset
        for name in self._peers:
            self.note_skew(name)

    def note_skew(self, name: str) -> None:
        """Note whether the clock of a neighbour, or the own one, is wrong by too much, now that more is known of it."""
        skew = self._find_skew(self._peers[name])
        if skew is not None and skew.exceeds(self._skew_limit_s):
            self.skewed[name] = skew
        else:
            self.skewed.pop(name, None)

    def clock_skews(self) -> dict[str, float]:
        """Neighbour -> by how much its clock is ahead, s, where that is known."""
        skews = ((name, self._find_skew(peer)) for name, peer in sorted(self._peers.items()))
        return {name: skew.ahead_s for name, skew in skews if skew is not None}

    def _find_skew(self, peer: Peer) -> Skew | None:
        skew = peer.clock.skew
        return skew and skew._replace(ahead_s=skew.ahead_s + peer.correction - self.correction)

    def absent_at(self, name: str) -> float:
        """When a neighbour counts as gone if it does not report until then that it receives us."""
        return self._peers[name].present_at + self._peers[name].patience_s

    def is_present(self, name: str, now: float) -> bool:
        """Whether a neighbour is there, and receives us as we receive it."""
        return name not in self.gone and self.absent_at(name) > now

    def present(self, now: float) -> frozenset[str]:
        """The neighbours that may be used."""
        return frozenset(name for name in self._peers if self.is_present(name, now)) - self.distrusted.keys()

    def is_of_former_incarnation(self, header: Header, now: float) -> bool:
        """Whether a message comes from a process that has ended since.

        If the later one is received no more, it may be that the clock of one that began still later was set back.
        """
        newest = self._peers[header.sender].incarnation
        return newest is not None and header.incarnation < newest and self.receives(header.sender, now)

    def receives(self, name: str, now: float) -> bool:
        """Whether we receive a neighbour."""
        peer = self._peers[name]
        return bool(now <= peer.received_at + peer.patience_s)

    def note_gone(self, name: str, leave_reason: str) -> None:
        """The process of a neighbour has ended."""
        self.gone[name] = leave_reason
        self._peers[name].present_at = -math.inf

    def stamp(self, name: str, message: M, now: float, *, is_complete: bool) -> M:
        """``message`` as it is sent to ``name`` now; ``is_complete``: what is to be stated of the own side."""
        peer, is_two_way = self._peers[name], isinstance(message, HeartbeatMessage | BoundaryUpdate)
        peer.note_sent(now)
        stated = term_of(message), is_two_way and is_complete  # a message of a round takes the latter back
        if (peer.sent_term, peer.sent_complete) != stated:
            (peer.sent_term, peer.sent_complete), peer.changed_at = stated, now
        link: dict[str, Any] = {"complete": is_complete} if is_two_way else {}
        return replace(
            message,
            header=replace(message.header, time=peer.next_time(now + self.clock_offset)),
            receives=self.receives(name, now) and name not in self.distrusted,  # else it would wait for us
            answers=peer.answers(now),
            received=peer.received,
            **link,
        )

    def due_times(self, now: float, is_at_rest: bool) -> Iterator[float]:
        """When heartbeats and repeats are due."""
        for name, peer in self._peers.items():
            yield peer.sent_at + self._quiet_s(name, now, is_at_rest)
            for sent in peer.outgoing:
                if sent.repeat is not None:
                    yield sent.repeat.at

    def take_due_repeats(self, now: float) -> Iterator[tuple[str, Any]]:
        """Which messages are to be sent again now, and to whom.

        A neighbour that is not there needs none: when it is back, its heartbeat reports that it lacks the message.
        """
        for name, peer in self._peers.items():
            for sent in peer.outgoing:
                if sent.repeat is None or sent.repeat.at > now:
                    continue
                if self.is_present(name, now):
                    sent.repeat = peer.wait_longer(sent.repeat, now, self._heartbeat_s)
                    yield name, sent.message
                else:
                    sent.repeat = None

    def owes_heartbeat(self, name: str, now: float, is_at_rest: bool, is_heartbeat: bool) -> bool:
        """Whether nothing has been sent for too long. ``is_heartbeat``: those that get one per heartbeat get it now."""
        sent_at, quiet_s = self._peers[name].sent_at, self._quiet_s(name, now, is_at_rest)
        if is_heartbeat and is_at_rest and quiet_s == self._heartbeat_s:
            return sent_at < now
        return now >= sent_at + quiet_s

    def _quiet_s(self, name: str, now: float, is_at_rest: bool) -> float:
        """How long nothing is sent: ever longer since the content of heartbeats has changed, as one may be lost, or on
        this link several; at rest a heartbeat at most, before no longer than patience allows. At rest a message to a
        neighbour that is there is repeated until that is received, ever more rarely, too: it may be slow.
        """
        peer = self._peers[name]
        longest_s = (
            self._heartbeat_s if is_at_rest else min(self._heartbeat_s, peer.patience_s / peer.patience_messages)
        )
        is_awaited = is_at_rest and peer.awaits_reply and self.is_present(name, now)
        since = peer.unanswered_since if is_awaited else peer.changed_at
        unchanged_s = (peer.sent_at - since) / math.sqrt(peer.mean_count)
        return min(longest_s, max(peer.round_trip.longest_wait_s, unchanged_s))

    def begin_term(self) -> None:
        """Messages of former rounds count no more; everybody is to learns of the term."""
        for peer in self._peers.values():
            peer.begin_term()

    def find_old(self, term: Term, links: frozenset[str], now: float, heartbeats: float = FRESH_HEARTBEATS) -> set[str]:
        """Neighbours not received, not receiving us, in another term, or with a side that they call incomplete."""
        return {
            name
            for name, peer in self._peers.items()
            if name not in links
            or not self.is_present(name, now)
            or now >= peer.received_at + heartbeats * self._heartbeat_s
            or peer.term != term
            or not peer.complete
        }

    def aging_times(self, now: float) -> Iterator[float]:
        """When what is fresh now will not be, if nothing is received until then."""
        for peer in self._peers.values():
            for heartbeats in (FRESH_HEARTBEATS, PASSED_ON_HEARTBEATS):
                if (at := peer.received_at + heartbeats * self._heartbeat_s) > now:
                    yield at
