"""Choice of the protocol that a strategy runs on, and of the messages that its areas send each other."""

from __future__ import annotations

from agents.messages.packing import HeartbeatMessage, Incarnation, LoadMessage
from agents.protocol.area_protocol import AreaProtocol
from agents.protocol.asynchronous import AsynchronousProtocol
from agents.protocol.configuration import Configuration
from agents.protocol.rounds import RoundsProtocol
from agents.strategies.installed import load_strategy
from agents.strategies.interface import Strategy
from dsse_core.errors import InvalidInputError


def make_protocol(content: Configuration, incarnation: Incarnation, *, now: float, started_at: float) -> AreaProtocol:
    """Returns the protocol of the strategy that the area file names; see ``AreaProtocol`` for the arguments.

    Raises:
        InvalidInputError: the strategy is not installed, or cannot be used, or not between these areas.
    """
    cls = load_strategy(content.strategy)
    if problems := cls.find_area_problems(content.strategy, [content.area]):
        raise InvalidInputError(f"area {content.area.name!r}", problems)
    if issubclass(cls, RoundsProtocol):
        return cls(content, incarnation, now=now, started_at=started_at)
    if issubclass(cls, Strategy):
        return AsynchronousProtocol(content, cls(content), incarnation, now=now, started_at=started_at)
    raise InvalidInputError(f"strategy {content.strategy!r}", [f"{cls.__name__} runs on no protocol; derive Strategy"])


def kinds_of(strategy: str) -> tuple[str, ...]:
    """Returns the kinds of messages that neighbours send each other under ``strategy``.

    Raises:
        InvalidInputError: the strategy is not installed, or cannot be used.
    """
    return LoadMessage.kind, HeartbeatMessage.kind, *load_strategy(strategy).kinds()
