"""Which protocol a strategy runs on, and which messages its areas send each other."""

from __future__ import annotations

from agents.area_files.area_file import AreaFile
from agents.messages.packing import HeartbeatMessage, Incarnation, LoadMessage
from agents.protocol.area_protocol import AreaProtocol
from agents.protocol.asynchronous import AsynchronousProtocol
from agents.protocol.rounds import RoundsProtocol
from agents.strategies import ASYNCHRONOUS, make_strategy

ROUNDS = "information"
STRATEGIES = ("angle-offset", ROUNDS, "admm")  # as they are compared


def make_protocol(content: AreaFile, incarnation: Incarnation, *, now: float, started_at: float) -> AreaProtocol:
    """The protocol of the strategy that the area file names; see ``AreaProtocol`` for the arguments."""
    if content.strategy == ROUNDS:
        return RoundsProtocol(content, incarnation, now=now, started_at=started_at)
    return AsynchronousProtocol(content, make_strategy(content), incarnation, now=now, started_at=started_at)


def kinds_of(strategy: str) -> tuple[str, ...]:
    """The kinds of messages that neighbours send each other under ``strategy``."""
    own = RoundsProtocol.kinds if strategy == ROUNDS else (ASYNCHRONOUS[strategy].kind,)
    return LoadMessage.kind, HeartbeatMessage.kind, *own
