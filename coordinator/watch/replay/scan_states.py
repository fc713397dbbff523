"""The state of a scan: of all states that an area publishes of it, the one that stands for the scan."""

from __future__ import annotations

from collections.abc import Iterable

from agents.messages.packing import StateMessage
from agents.protocol.quality import GOOD


def stands_for_scan(quality: str, last: str) -> bool:
    """True where a state of ``quality`` stands for its scan in place of an earlier one of quality ``last``; "": none.

    The last good state stands for the scan, else the last one.
    """
    return quality == GOOD or last != GOOD


class ScanStates:
    """The state of each area that stands for ``scan``. ``changed_at``: time of the last change of estimate or quality,
    s.
    """

    def __init__(self, scan: int, began_at: float) -> None:
        self.scan = scan
        self.best: dict[str, StateMessage] = {}
        self.changed_at = began_at

    def take(self, at: float, state: StateMessage) -> None:
        """Takes in a state published at time ``at``, s; ignores states of other scans."""
        if state.header.scan != self.scan:
            return
        name = state.header.sender
        last = self.best.get(name)
        if last is None or last.header.order != state.header.order or last.quality != state.quality:
            self.changed_at = at
        if stands_for_scan(state.quality, last.quality if last else ""):
            self.best[name] = state

    def are_good(self, names: Iterable[str]) -> bool:
        """True where all areas ``names`` have published a good state."""
        return all(name in self.best and self.best[name].quality == GOOD for name in names)
