"""Which protocol a strategy runs on, and which messages its areas send each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

from agents.area_file import AreaFile
from agents.events import Action, Event
from agents.messages import DownMessage, HeartbeatMessage, Incarnation, LoadMessage, UpMessage
from agents.protocol import AreaProtocol
from agents.rounds import RoundsProtocol
from agents.strategies import ASYNCHRONOUS, make_strategy

ROUNDS = "information"
STRATEGIES = ("angle-offset", ROUNDS, "admm")  # as they are compared


class AgentProtocol(Protocol):
    """Events and time in, actions out; no bus, no clock, no randomness."""

    def describe_backend(self) -> str:
        """For the log: what computes the exchange; empty without such a choice."""
        ...

    def wait_s(self, now: float) -> float:
        """How long the protocol may be left alone, s."""
        ...

    def handle(self, events: Sequence[Event], now: float) -> Iterator[Action]:
        """Take in ``events``, all that arrived since the last call, and say what to do, one by one as it is known."""
        ...


def make_protocol(content: AreaFile, incarnation: Incarnation, *, now: float, started_at: float) -> AgentProtocol:
    """The protocol of the strategy that the area file names; see ``AreaProtocol`` for the arguments."""
    if content.strategy == ROUNDS:
        return RoundsProtocol(content, incarnation, now=now, started_at=started_at)
    return AreaProtocol(content, make_strategy(content), incarnation, now=now, started_at=started_at)


def kinds_of(strategy: str) -> tuple[str, ...]:
    """The kinds of messages that neighbours send each other under ``strategy``."""
    if strategy == ROUNDS:
        return LoadMessage.kind, HeartbeatMessage.kind, UpMessage.kind, DownMessage.kind
    return LoadMessage.kind, ASYNCHRONOUS[strategy].kind
