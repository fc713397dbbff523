"""What was last said to each neighbour: a word is numbered anew where it says something new, else it is repeated."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

from agents.events import Publish
from agents.freshness import renew
from agents.messages import BoundaryNews, Header, LoadMessage, Message
from dsse_core.boundary_load import NetLoad, load_message_for
from dsse_core.partition import Neighbour

NEWS_LOAD = 1e-9  # p.u.


class HasScan(Protocol):
    """Who knows the current scan."""

    @property
    def scan(self) -> int: ...


class LastWords:
    """``loads``, ``boundary``: neighbour -> the newest message to it.

    Args:
        header_for: the header of a message that follows the given one.
    """

    def __init__(
        self, neighbours: Sequence[Neighbour], hearing: HasScan, header_for: Callable[[Message | None], Header]
    ) -> None:
        self.loads: dict[str, LoadMessage] = {}
        self.boundary: dict[str, BoundaryNews] = {}
        self._neighbours = neighbours
        self._hearing = hearing
        self._header_for = header_for

    def is_outdated(self, message: Message | None) -> bool:
        """Whether ``message`` is none, or of a former scan: what follows it is news, whatever it says."""
        return message is None or message.header.scan != self._hearing.scan

    def tell_loads(self, own: NetLoad, heard: Mapping[str, NetLoad]) -> list[Publish]:
        """Tell a neighbour the net load on this side once all the other neighbours have told theirs."""
        missing = {n.area for n in self._neighbours} - heard.keys()
        told: list[Publish] = []
        for n in self._neighbours:
            if missing - {n.area}:
                continue
            load = load_message_for(n.area, own, heard)
            sigma, last = load.variance**0.5, self.loads.get(n.area)
            moved = last is None or max(abs(last.load.s - load.s), abs(last.sigma - sigma)) > NEWS_LOAD
            if moved or self.is_outdated(last):
                message = LoadMessage(self._header_for(last), n.bus, load.s.real, load.s.imag, sigma)
                self.loads[n.area] = message
                told.append(Publish(message, n.area))
        return told

    def tell_boundary(self, message: BoundaryNews, name: str) -> Publish:
        """Tell neighbour ``name`` something new of the boundary."""
        self.boundary[name] = message
        return Publish(message, name)

    def tell_freshness(self, fresh: Mapping[str, bool]) -> Iterator[Publish]:
        """Which words have come to rest on something old, or no longer do; those of a former scan will be replaced.

        ``fresh``: neighbour -> whether all that a word to it rests on is fresh now.
        """
        for name, is_fresh in fresh.items():
            message = self.boundary.get(name)
            if message is not None and message.fresh != is_fresh and not self.is_outdated(message):
                time = self._header_for(None).time
                yield self.tell_boundary(renew(message, is_fresh, time), name)

    def repeat(self) -> Iterator[Publish]:
        """All of it once more."""
        for name in dict.fromkeys(n.area for n in self._neighbours):
            for message in (self.loads.get(name), self.boundary.get(name)):
                if message is not None:
                    yield Publish(message, name)
