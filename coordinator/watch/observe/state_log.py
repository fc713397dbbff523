"""Log of the areas' states: their changes as events in ``events.jsonl``, and link faults counted by kind."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from agents.messages.packing import Incarnation, StateMessage
from agents.runtime.link_faults import FAULT_KINDS
from coordinator.watch.observe.event_log import EventLog

NO_COMMAND = (0, 0, 0)


@dataclass
class StateLog:
    """``events``: the log to write, if any; ``faults``: kind -> number of messages, in all incarnations."""

    events: EventLog | None
    faults: Counter[str] = field(default_factory=Counter)
    _quality: dict[str, str] = field(default_factory=dict)
    _commands: dict[str, tuple[int, int, int]] = field(default_factory=dict)  # area -> last command followed
    _counted: dict[str, tuple[Incarnation, Counter[str]]] = field(default_factory=dict)  # of each area's incarnation

    def take(self, state: StateMessage, at: float, is_new: bool) -> None:
        """Note ``state``, an area's newest, published at time ``at``; ``is_new``: it is no repeat."""
        area = state.header.sender
        # a hostile area may invent more kinds
        counted = Counter({kind: state.faults[kind] for kind in FAULT_KINDS if kind in state.faults})
        incarnation, before = self._counted.get(area, (state.header.incarnation, Counter()))
        before = before if incarnation == state.header.incarnation else Counter()
        more = counted - before
        self._counted[area] = (state.header.incarnation, before | counted)
        self.faults += more
        if self.events is None:
            return
        if state.command != self._commands.get(area, NO_COMMAND):
            self._commands[area] = state.command
            self.events.write(
                "command followed", at, area=area, command=list(state.command), meters_off=list(state.meters_off)
            )
        if is_new:
            self._write_change(self.events, state, at)
        if more:
            self.events.write("link faults", at, area=area, **dict(sorted(more.items())))
        if state.quality != self._quality.get(area):
            self._quality[area] = state.quality
            self.events.write("quality", at, area=area, scan=state.header.scan, quality=state.quality)

    def _write_change(self, events: EventLog, state: StateMessage, at: float) -> None:
        events.write(
            "state changed",
            at,
            area=state.header.sender,
            scan=state.header.scan,
            sequence=state.header.sequence,
            estimated=bool(state.buses),
            referenced=state.referenced,
            sent=state.sent,
            received=state.received,
            notes=list(state.notes),
        )
