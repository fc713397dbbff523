"""The links of an area to its neighbours: between protocol and bus, with the faults of the scenario.

A machine without clock or threads, like the protocol: messages and time in, payloads for the bus out. A delayed
message waits in a queue until the loop calls ``release`` at the time of ``next_due``.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from agents.messages.packing import Message, StateMessage, encode
from agents.runtime.link_faults import CORRUPTED, CUT, DELAYED, DUPLICATED, LOSSES, OVERTAKEN, LinkFate
from dsse_core.link_faults import LinkFaults

SOUND = LinkFaults()
_Held = tuple[float, int, str, str, int, bytes]  # due, order, receiver, kind, number, payload


@dataclass
class FaultyLinks:
    """Sends messages of area ``sender``; ``faults``: neighbour -> faults of the link to it.

    ``messages``, ``bytes``: handed over for neighbours, repeats and lost ones included; ``met``: kind of fault ->
    number of times it has happened.
    """

    sender: str
    faults: Mapping[str, LinkFaults]
    seed: int
    put: Callable[[str | None, str, bytes], None]  # (neighbour or None for watchers, kind, payload)
    messages: int = 0
    bytes: int = 0
    met: Counter[str] = field(default_factory=Counter)
    _began: float | None = None
    _fates: dict[str, LinkFate] = field(default_factory=dict)
    _waiting: list[_Held] = field(default_factory=list)
    _order: itertools.count[int] = field(default_factory=itertools.count)
    _newest: Counter[str] = field(default_factory=Counter)  # number of the newest message that has gone out

    @property
    def lost(self) -> int:
        """Messages that never reach the bus."""
        return sum(self.met[kind] for kind in LOSSES)

    def begin(self, at: float) -> None:
        """Note that the run began at time ``at``: windows of faults count from there; before this call none is open."""
        self._began = at

    def send(self, message: Message, to: str | None, now: float) -> None:
        """Hand ``message`` to the bus for neighbour ``to``, or for watchers (None; without faults)."""
        if to is None:
            self.put(None, message.kind, encode(self.with_counts(message)))
            return
        faults = self.faults.get(to, SOUND)
        fate = self._fates.get(to) or self._fates.setdefault(to, LinkFate(faults, self.seed, self.sender, to))
        if fate.is_sound:
            self._put_at_once(message, to)
            return
        fate.next()
        elapsed = now - self._began if self._began is not None else -math.inf
        over = faults.until_s is not None and elapsed >= faults.until_s
        message, falsified = (message, "") if over else fate.falsify(message)
        payload = encode(message)
        self.messages += 1
        self.bytes += len(payload)
        if any(start <= elapsed < end for start, end in faults.cuts):
            self.met[CUT] += 1
        elif not over and (reason := fate.find_loss()):
            self.met[reason] += 1
        else:
            self._count(falsified)
            copies = [(0.0, payload, False)] if over else fate.copies(payload)
            self._count(DUPLICATED if len(copies) > 1 else "")
            for delay, content, damaged in copies:
                self._count(CORRUPTED if damaged else "")
                self._count(DELAYED if delay > 0 else "")
                entry = (now + delay, next(self._order), to, message.kind, fate.number, content)
                heapq.heappush(self._waiting, entry)
            self.release(now)

    def _put_at_once(self, message: Message, to: str) -> None:
        payload = encode(message)
        self.messages += 1
        self.bytes += len(payload)
        self.put(to, message.kind, payload)

    def _count(self, kind: str) -> None:
        """Count a fault of ``kind``; an empty ``kind`` is none."""
        if kind:
            self.met[kind] += 1

    def with_counts(self, message: Message) -> Message:
        """``message``; a state gets the counts of the links."""
        if not isinstance(message, StateMessage):
            return message
        met = dict(self.met)
        return replace(message, messages=self.messages, bytes=self.bytes, lost=self.lost, faults=met)

    def next_due(self) -> float:
        """Time at which the next delayed message goes out; infinity if none waits."""
        return self._waiting[0][0] if self._waiting else math.inf

    def release(self, now: float) -> None:
        """Hand over the delayed messages that are due at ``now``."""
        while self._waiting and self._waiting[0][0] <= now:
            _, _, to, kind, number, payload = heapq.heappop(self._waiting)
            if number < self._newest[to]:
                self.met[OVERTAKEN] += 1
            self._newest[to] = max(self._newest[to], number)
            self.put(to, kind, payload)
