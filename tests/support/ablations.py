"""The protocol of rounds with one of its rules left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any
from unittest import mock

from agents.peers.peer_table import PeerTable
from agents.peers.peers import Peer
from agents.protocol.numbering import ScanReadings, TelemetryUpdate
from agents.protocol.rounds import RoundsProtocol

_take, _stamp = ScanReadings.take, PeerTable.stamp
_go_on, _take_in_term = RoundsProtocol._go_on, RoundsProtocol._take_in_term


def _is_silent_when_idle() -> AbstractContextManager[object]:
    return mock.patch.object(PeerTable, "_quiet_s", return_value=math.inf)


def _ignores_late_readings() -> AbstractContextManager[object]:
    def take(self: ScanReadings, *message: Any) -> TelemetryUpdate:
        update = _take(self, *message)
        return TelemetryUpdate.NONE if update is TelemetryUpdate.LATE else update

    return mock.patch.object(ScanReadings, "take", take)


def _joins_within_a_term() -> AbstractContextManager[object]:
    def must_change_for(self: RoundsProtocol, name: str, message: Any, is_restart: bool) -> bool:
        if message.receives and not is_restart and (message.header.scan, message.revision) == self.term:
            self.round.links |= {name}
            return False
        return is_restart or (name not in self.round.links and message.receives)

    return mock.patch.object(RoundsProtocol, "_must_change_for", must_change_for)


def _never_rejoins() -> AbstractContextManager[object]:
    return mock.patch.object(RoundsProtocol, "_must_change_for", lambda self, name, message, is_restart: is_restart)


def _ignores_restarts() -> AbstractContextManager[object]:
    def must_change_for(self: RoundsProtocol, name: str, message: Any, is_restart: bool) -> bool:
        return name not in self.round.links and message.receives

    return mock.patch.object(RoundsProtocol, "_must_change_for", must_change_for)


def _goes_on_while_a_change_is_due() -> AbstractContextManager[object]:
    def without(method: Callable[..., Iterator[Any]]) -> Callable[..., Iterator[Any]]:
        def go_on(self: RoundsProtocol, *arguments: Any) -> Iterator[Any]:
            is_due, self._is_change_due, term = self._is_change_due, False, self.term
            yield from method(self, *arguments)
            self._is_change_due |= is_due and self.term == term

        return go_on

    return mock.patch.multiple(RoundsProtocol, _go_on=without(_go_on), _take_in_term=without(_take_in_term))


def _takes_who_is_received_for_present() -> AbstractContextManager[object]:
    take = Peer.take

    def receive(self: Peer, message: Any, now: float, wall: float, **more: Any) -> None:
        take(self, message, now, wall, **more)
        self.present_at = now

    return mock.patch.object(Peer, "take", receive)


ABLATIONS: Mapping[str, Callable[[], AbstractContextManager[object]]] = {
    "says where it stands when idle": _is_silent_when_idle,
    "late readings raise": _ignores_late_readings,
    "the set of links is fixed within a term": _joins_within_a_term,
    "rejoins who is received": _never_rejoins,
    "a restart raises": _ignores_restarts,
    "while a change is due, sends and takes no Up or Down": _goes_on_while_a_change_is_due,
    "presence is two-way": _takes_who_is_received_for_present,
}
