"""The splits on which an area, its neighbours and its telemetry work: all files must be of one, and not edited."""

from __future__ import annotations

from collections.abc import Iterable

from agents.messages.packing import HeartbeatMessage, Message, TelemetryMessage
from dsse_core.estimation.decision import MOST_NAMED
from dsse_core.split_identity import NO_SPLIT, SplitIdentity, SplitUse, add_uses, are_of_one


class Splits:
    """``own``: the split of the file of area ``name``. ``others``: neighbour, or sender of telemetry, whose split is
    another one -> that split. Gateways know no split, and a plant without one is a gateway. ``held``: the split of the
    file that lies ready for the next scan, NO_SPLIT without one that can be used; ``edited_next``: of one that cannot.
    """

    def __init__(self, name: str, own: SplitIdentity) -> None:
        self.own = own
        self.others: dict[str, SplitIdentity] = {}
        self.held = self.edited_next = NO_SPLIT
        self._name = name

    def take(self, message: Message) -> None:
        """Note what a message states of its sender, which is a neighbour or sends readings."""
        name = message.header.sender
        match message:
            case HeartbeatMessage(split=split) if split != self.own:
                self.others[name] = split
            case TelemetryMessage(split=split) if split.digest and split != self.own:
                self.others[name] = split
            case HeartbeatMessage() | TelemetryMessage():
                self.others.pop(name, None)

    def add_to(self, uses: Iterable[SplitUse]) -> tuple[SplitUse, ...]:
        """``uses``, of this area and others, with all that is known here."""
        known = ((self._name, self.own), *self.others.items())
        return add_uses((*uses, *(SplitUse(split, (name,)) for name, split in known)), MOST_NAMED)

    def are_one(self, uses: Iterable[SplitUse] = ()) -> bool:
        """Whether these areas, all neighbours and the telemetry are of one split, and no file of it was edited."""
        return are_of_one(self.add_to(uses))
