"""Effect of the faults of a directed link on its n-th message: drawn from the seed, the link and n alone.

The effect is the same on the real bus and on the simulator. Repeats and load messages count like all others.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property

from agents.messages.packing import LoadMessage, Message
from agents.runtime.lies import Liar
from dsse_core.link_faults import LinkFaults

LOST, BURST, CUT = "lost", "lost in a burst", "lost in a cut"
DELAYED, OVERTAKEN, DUPLICATED, CORRUPTED = "delayed", "overtaken", "duplicated", "corrupted"
LOAD_CHANGED, LIED = "load changed", "lied"
LOSSES = (LOST, BURST, CUT)
FAULT_KINDS = (*LOSSES, DELAYED, OVERTAKEN, DUPLICATED, CORRUPTED, LOAD_CHANGED, LIED)
MOST_FLIPPED = 3  # bytes


def draw_fate(seed: int, sender: str, receiver: str, number: int, what: str = "") -> float:
    """A uniform number in [0, 1) for message ``number`` of a directed link; each purpose ``what`` has its own."""
    link = f"{seed}/{sender}/{receiver}/{number}" + (f"/{what}" if what else "")
    digest = hashlib.blake2b(link.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") / 2**64


@dataclass
class LinkFate:
    """The fates of one link's messages, in their order.

    ``number``: of the current message, from 0; -1 before the first. ``bad``: True inside a burst.
    """

    faults: LinkFaults
    seed: int
    sender: str
    receiver: str
    number: int = -1
    bad: bool = False
    _first_load: LoadMessage | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        f = self.faults
        self._liar = Liar(f) if f.lies_of_boundary or f.lies_of_totals or f.lie_verdict else None

    @cached_property
    def is_sound(self) -> bool:
        """True where the link has no faults."""
        return self.faults == LinkFaults()

    def next(self) -> None:
        """Go on to the next message."""
        self.number += 1
        f = self.faults
        if f.burst_enter:
            change = f.burst_leave if self.bad else f.burst_enter
            self.bad ^= self._draw("burst") < change

    def find_loss(self) -> str:
        """Kind of fault by which the message is lost; empty if it is not lost."""
        if self.bad:
            return BURST if self._draw("loss in a burst") < self.faults.burst_loss else ""
        return LOST if self.faults.loss and self._draw("") < self.faults.loss else ""

    def falsify(self, message: Message) -> tuple[Message, str]:
        """The message as the link sends it, and the kind of fault; empty if the message is unchanged."""
        f = self.faults
        if isinstance(message, LoadMessage):
            if not f.changes_loads:
                return message, ""
            changed = self._change_load(message)
            return changed, LOAD_CHANGED if changed != message else ""
        lie = self._liar.falsify(message) if self._liar else message
        return lie, LIED if lie != message else ""

    def copies(self, payload: bytes) -> list[tuple[float, bytes, bool]]:
        """(delay in s, bytes, True if damaged) of every copy to deliver."""
        again = self.faults.duplicate and self._draw("duplicate") < self.faults.duplicate
        return [self._copy(payload, copy) for copy in (("", " again") if again else ("",))]

    def _copy(self, payload: bytes, copy: str) -> tuple[float, bytes, bool]:
        f = self.faults
        delay = f.delay_s + (f.jitter_s * self._draw(f"delay{copy}") if f.jitter_s else 0.0)
        damaged = f.corrupt > 0 and self._draw(f"corrupt{copy}") < f.corrupt
        return delay, self._damage(payload, copy) if damaged else payload, damaged

    def _damage(self, payload: bytes, copy: str) -> bytes:
        """One to three bytes flipped, or, half of the time, the end cut off."""
        if self._draw(f"cut off{copy}") < 0.5:
            return payload[: int(self._draw(f"length{copy}") * len(payload))]
        damaged = bytearray(payload)
        for k in range(1 + int(self._draw(f"flips{copy}") * MOST_FLIPPED)):
            place = int(self._draw(f"place {k}{copy}") * len(payload))
            damaged[place] ^= 1 + int(self._draw(f"bits {k}{copy}") * 255)
        return bytes(damaged) if damaged != payload else payload[:-1]  # two flips may have undone each other

    def _change_load(self, message: LoadMessage) -> LoadMessage:
        f = self.faults
        self._first_load = self._first_load or message
        sent = self._first_load if f.load_frozen else message
        p, q = (tuple(f.load_scale * s + more for s in of) for of, more in ((sent.p, f.load_p), (sent.q, f.load_q)))
        return replace(message, p=p, q=q)

    def _draw(self, what: str) -> float:
        return draw_fate(self.seed, self.sender, self.receiver, self.number, what)
