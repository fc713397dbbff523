"""The lossy link: stands between protocol and transport, counts what is sent and drops what its faults say.

The fate of a message depends on the seed, the directed link and the number of the message on that link, so
the n-th message of a link meets the same fate in every run. Repeats and load messages count like all others.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from agents.messages import Message, StateMessage, encode
from dsse_core.link_faults import LinkFaults


@dataclass
class LossyLink:
    """Sends messages of area ``sender``; ``faults``: neighbour -> those of the link to it."""

    sender: str
    faults: Mapping[str, LinkFaults]
    seed: int
    put: Callable[[str | None, str, bytes], None]  # (neighbour or None for watchers, kind, payload)
    messages: int = 0
    bytes: int = 0
    lost: int = 0
    _count: Counter[str] = field(default_factory=Counter)

    def send(self, message: Message, to: str | None) -> None:
        """Hand ``message`` to the bus for neighbour ``to``, or for whoever watches (None; never lost)."""
        if to is None:
            if isinstance(message, StateMessage):
                message = replace(message, messages=self.messages, bytes=self.bytes, lost=self.lost)
            self.put(None, message.kind, encode(message))
            return
        payload = encode(message)
        number = self._count[to]
        self._count[to] += 1
        self.messages += 1
        self.bytes += len(payload)
        if draw_fate(self.seed, self.sender, to, number) < self.faults.get(to, LinkFaults()).loss:
            self.lost += 1
        else:
            self.put(to, message.kind, payload)


def draw_fate(seed: int, sender: str, receiver: str, number: int) -> float:
    """A uniform number in [0, 1) that belongs to message ``number`` of a directed link."""
    digest = hashlib.blake2b(f"{seed}/{sender}/{receiver}/{number}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") / 2**64
