"""The neighbours of an area: which are present, the last message to each, and the messages that are due."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from agents.messages.packing import BoundaryUpdate, Header, HeartbeatMessage, LinkMessage
from agents.peers.clock_skew import ClockSkew, Skew
from agents.peers.orders_and_ages import FRESH_HEARTBEATS, PASSED_ON_HEARTBEATS
from agents.peers.peers import Peer, Term, term_of
from dsse_core.grid.partition import Neighbour

M = TypeVar("M", bound=LinkMessage)


class PeerTable:
    """Table of the neighbours of an area.

    ``gone``: neighbours whose processes have ended -> reason of their leave message, empty without one.
    ``distrusted``: neighbour -> why its messages are not used in this scan. ``skewed``: neighbours whose clocks are too
    far from the own one -> skew. ``correction``: lead of the own clock over the own send times, s; never positive.

    Args:
        clock_offset: from monotonic to wall-clock time, s, as send times state it.
        skew_limit_s: largest allowed difference of clocks, s.
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
        self._peers = {n.area: Peer(now, now + clock_offset, heartbeat_s) for n in neighbours}
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
        """Follows the own clock, now set ``offset`` from monotonic time: send times go forward with it, never back."""
        if offset > self.clock_offset:
            self.clock_offset = offset
            for peer in self._peers.values():  # messages sent before measure no round trip
                peer.since, peer.clock = now + offset, ClockSkew()
        self.correction = offset - self.clock_offset
        for name in self._peers:
            self.note_skew(name)

    def note_skew(self, name: str) -> None:
        """Puts a neighbour into ``skewed`` if its clock certainly differs from the own one by more than the limit.

        Otherwise takes it out.
        """
        skew = self._find_skew(self._peers[name])
        if skew is not None and skew.exceeds(self._skew_limit_s):
            self.skewed[name] = skew
        else:
            self.skewed.pop(name, None)

    def clock_skews(self) -> dict[str, float]:
        """Neighbour -> lead of its clock over the own one, s, where that is known."""
        skews = ((name, self._find_skew(peer)) for name, peer in sorted(self._peers.items()))
        return {name: skew.ahead_s for name, skew in skews if skew is not None}

    def _find_skew(self, peer: Peer) -> Skew | None:
        skew = peer.clock.skew
        return skew and skew._replace(ahead_s=skew.ahead_s + peer.correction - self.correction)

    def absent_at(self, name: str) -> float:
        """Returns the time at which a neighbour counts as gone unless it reports before then that it receives us."""
        return self._peers[name].present_at + self._peers[name].patience_s

    def is_present(self, name: str, now: float) -> bool:
        """True where a neighbour has not ended, and has reported within its patience that it receives us."""
        return name not in self.gone and self.absent_at(name) > now

    def present(self, now: float) -> frozenset[str]:
        """The neighbours that may be used."""
        return frozenset(name for name in self._peers if self.is_present(name, now)) - self.distrusted.keys()

    def is_of_former_incarnation(self, header: Header, now: float) -> bool:
        """True where a message comes from a process that has ended since: a later one is received.

        If the later process is received no more, the message may come from a process that began after it, with a clock
        that was set back.
        """
        newest = self._peers[header.sender].incarnation
        return newest is not None and header.incarnation < newest and self.receives(header.sender, now)

    def receives(self, name: str, now: float) -> bool:
        """True where the last message of a neighbour arrived within its patience."""
        peer = self._peers[name]
        return bool(now <= peer.received_at + peer.patience_s)

    def note_gone(self, name: str, leave_reason: str) -> None:
        """Notes that the process of a neighbour has ended."""
        self.gone[name] = leave_reason
        self._peers[name].present_at = -math.inf

    def stamp(self, name: str, message: M, now: float, *, is_complete: bool) -> M:
        """Returns ``message`` as it is sent to ``name`` now; ``is_complete``: its statement about the own side."""
        peer, is_two_way = self._peers[name], isinstance(message, HeartbeatMessage | BoundaryUpdate)
        peer.note_sent(now)
        stated = term_of(message), is_two_way and is_complete  # a message of a round takes the latter back
        if (peer.sent_term, peer.sent_complete) != stated:
            (peer.sent_term, peer.sent_complete), peer.changed_at = stated, now
        link: dict[str, Any] = {"complete": is_complete} if is_two_way else {}
        return replace(
            message,
            header=replace(message.header, time=peer.next_time(now + self.clock_offset)),
            receives=self.receives(name, now) and name not in self.distrusted,  # otherwise it would wait for this area
            answers=peer.answers(now),
            received=peer.received,
            **link,
        )

    def due_times(self, now: float, is_at_rest: bool) -> Iterator[float]:
        """Times at which heartbeats and repeats are due."""
        for name, peer in self._peers.items():
            yield peer.sent_at + self._quiet_s(name, now, is_at_rest)
            for sent in peer.outgoing:
                if sent.repeat is not None:
                    yield sent.repeat.at

    def take_due_repeats(self, now: float) -> Iterator[tuple[str, Any]]:
        """Yields each neighbour and message whose repeat is due now.

        A neighbour that is absent gets no repeat: when it is back, its heartbeat reports that it lacks the message.
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
        """True where the last message to a neighbour was sent too long ago.

        ``is_heartbeat``: a heartbeat interval of this area ends now. At rest a neighbour that gets one heartbeat per
        interval gets it at this moment.
        """
        sent_at, quiet_s = self._peers[name].sent_at, self._quiet_s(name, now, is_at_rest)
        if is_heartbeat and is_at_rest and quiet_s == self._heartbeat_s:
            return sent_at < now
        return now >= sent_at + quiet_s

    def _quiet_s(self, name: str, now: float, is_at_rest: bool) -> float:
        """Returns the time, s, between the last message to a neighbour and the next heartbeat.

        The time grows with the time since the content of heartbeats changed, as one heartbeat may be lost, or on this
        link several. At rest it is at most a heartbeat interval; before, also at most the share of patience of one
        message. At rest it also grows while a present neighbour, which may be slow, leaves a message unanswered.
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
        """Drops the messages of former rounds; owes each neighbour a heartbeat that announces the term."""
        for peer in self._peers.values():
            peer.begin_term()

    def find_old(self, term: Term, links: frozenset[str], now: float, heartbeats: float = FRESH_HEARTBEATS) -> set[str]:
        """Returns the neighbours not in ``links``, not received for ``heartbeats``, not receiving us, in another term,
        or with a side that they state as incomplete.
        """
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
        """Times at which a neighbour that is fresh now becomes old, if no message of it arrives before."""
        for peer in self._peers.values():
            for heartbeats in (FRESH_HEARTBEATS, PASSED_ON_HEARTBEATS):
                if (at := peer.received_at + heartbeats * self._heartbeat_s) > now:
                    yield at
