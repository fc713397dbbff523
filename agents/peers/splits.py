"""The splits on which an area, its neighbours and its telemetry work: all files must be of one, and not edited."""

from __future__ import annotations

from collections.abc import Iterable

from agents.messages.packing import HeartbeatMessage, Message, TelemetryMessage
from dsse_core.estimation.decision import MOST_NAMED
from dsse_core.split_identity import NO_SPLIT, SplitIdentity, SplitUse, add_uses, are_of_one


class Splits:
    """Splits of an area, its neighbours and its telemetry.

    ``own``: the split of the file of area ``name``. ``others``: neighbour, or sender of telemetry, with another split
    -> that split. Gateways know no split, and a plant without a split is a gateway. ``held``: the split of the file
    that lies ready for the next scan, NO_SPLIT without a usable file. ``edited_next``: the split of a file that lies
    ready and was edited, NO_SPLIT without one.
    """

    def __init__(self, name: str, own: SplitIdentity) -> None:
        self.own = own
        self.others: dict[str, SplitIdentity] = {}
        self.held = self.edited_next = NO_SPLIT
        self._name = name

    def take(self, message: Message) -> None:
        """Notes the split of the sender of a message, which is a neighbour or sends readings."""
        name = message.header.sender
        match message:
            case HeartbeatMessage(split=split) if split != self.own:
                self.others[name] = split
            case TelemetryMessage(split=split) if split.digest and split != self.own:
                self.others[name] = split
            case HeartbeatMessage() | TelemetryMessage():
                self.others.pop(name, None)

    def add_to(self, uses: Iterable[SplitUse]) -> tuple[SplitUse, ...]:
        """Returns ``uses``, of this area and others, with all splits that this area knows of."""
        known = ((self._name, self.own), *self.others.items())
        return add_uses((*uses, *(SplitUse(split, (name,)) for name, split in known)), MOST_NAMED)

    def are_one(self, uses: Iterable[SplitUse] = ()) -> bool:
        """True where these areas, all neighbours and the telemetry are of one split, and no file of it was edited."""
        return are_of_one(self.add_to(uses))
