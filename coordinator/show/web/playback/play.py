"""The updates of a run, states, readings and presence, and the messages between areas."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from agents.messages.keys import live_key
from agents.messages.packing import Header, Incarnation, Message, ReadingsMessage, StateMessage
from agents.protocol.configuration import Configuration
from coordinator.lab.simulator.subscriber import Subscriber
from coordinator.watch.replay.recorded_messages import MOST_VALUES, Presence, Update, count_values

MOST_MESSAGES = 200_000  # between areas
WAYS = 2  # a message counts as lost after this multiple of the longest travel time so far
IN_SIMULATION = Incarnation(1, 1)  # in the presence tokens of the areas of a simulation


@dataclass(slots=True)
class Sent:
    """A message to ``receiver``. ``arrived``: time of its arrival; None if it is lost or still on its way."""

    sender: str
    receiver: str
    kind: str
    at: float
    arrived: float | None = None


@dataclass
class Play(Subscriber):
    """The play of ``run``: its ``updates`` in order, with their times, and ``messages`` between areas.

    Times are s from the begin of the play. ``since``: time of this begin, s since 1970; 0 for a simulated run.
    ``is_full``: no more room; further updates and messages are dropped.
    """

    run: str = ""
    since: float = 0.0
    updates: list[tuple[float, Update]] = field(default_factory=list)
    messages: list[Sent] = field(default_factory=list)
    is_full: bool = False
    _values: int = 0
    _on_the_way: dict[tuple[object, ...], Sent] = field(default_factory=dict)

    def begin(self, run: str, files: Sequence[Configuration]) -> None:
        self.run = run

    def take_state(self, at: float, state: StateMessage) -> None:
        self._take(at, state)

    def take_readings(self, at: float, readings: ReadingsMessage) -> None:
        self._take(at, readings)

    def take_presence(self, at: float, area: str, alive: bool) -> None:
        self._take(at, Presence(live_key(self.run, "area", area, IN_SIMULATION), alive))

    def _take(self, at: float, item: Update) -> None:
        self._values += count_values(item)
        self.is_full = self.is_full or self._values > MOST_VALUES
        if not self.is_full:
            self.updates.append((at, item))

    def take_message(self, at: float, receiver: str, message: Message, arrives: bool) -> None:
        header, kind = message.header, message.kind
        identity = _identify(header, receiver, kind)
        self.is_full = self.is_full or len(self.messages) >= MOST_MESSAGES
        if not arrives and not self.is_full:
            sent = Sent(header.sender, receiver, kind, at)
            self.messages.append(sent)
            self._on_the_way[identity] = sent
        elif (found := self._on_the_way.pop(identity, None)) is not None:
            found.arrived = at

    def copy_settled(self) -> Play:
        """A copy of the settled part of a play that another thread extends. Its end is left out, because messages sent
        there may still arrive.
        """
        updates, messages = list(self.updates), list(self.messages)
        now = max((*(at for at, _ in updates[-1:]), *(sent.at for sent in messages[-1:])), default=0.0)
        arrived = [(sent, at) for sent in messages if (at := sent.arrived) is not None]
        longest_s = max((at - sent.at for sent, at in arrived), default=math.inf)
        until = max(now - WAYS * longest_s, messages[0].at) if messages else math.inf  # without messages all is settled
        return Play(
            run=self.run,
            since=self.since,
            updates=[(at, item) for at, item in updates if at < until],
            messages=[replace(sent) for sent in messages if sent.at < until],
        )


def _identify(header: Header, receiver: str, kind: str) -> tuple[object, ...]:
    return header.sender, receiver, kind, header.sequence, header.time
