"""Statuses of the switches of an area, as the operator orders and gateways read them.

A status holds until another one of its source comes, and does not age. Two sources that contradict each other leave it
unknown; a switch of unknown status stays as it was.
"""

from __future__ import annotations

from collections.abc import Mapping

from agents.messages.packing import TelemetryMessage
from dsse_core.grid.switches import UNKNOWN, name_status_meter, name_statuses, read_status, read_statuses
from dsse_core.reading_rules import ReadingRules, replaces

ORDERED = "the operator has ordered"


class Statuses:
    """``closed``: switch of the area -> True where it is closed, from the next term on. ``unknown``: switch -> sentence
    on what is told of it, where its status is unknown. ``meters``: id of a status as a reading -> its switch.

    Args:
        closed: switch -> its status in the area file.
        lead_s: longest time by which a status may be ahead of the area's clock, s.
    """

    def __init__(self, closed: Mapping[str, bool], rules: ReadingRules, lead_s: float) -> None:
        self.closed = dict(closed)
        self.unknown: dict[str, str] = {}
        self.meters = {name_status_meter(switch): switch for switch in closed}
        self._rules = rules
        self._lead_s = lead_s
        self._ordered: dict[str, str] = {}
        self._read: dict[str, dict[str, tuple[tuple[object, ...], str]]] = {}  # switch -> gateway -> order and status

    def follow(self, ordered: Mapping[str, bool]) -> bool:
        """Takes all orders of the operator; returns whether the status of a switch changes."""
        self._ordered = name_statuses({switch: ordered[switch] for switch in self.closed if switch in ordered})
        return self._decide()

    def take(self, message: TelemetryMessage, wall: float) -> bool:
        """Takes the statuses in ``message`` that are newer; returns whether the status of a switch changes.

        ``wall``: now, s since 1970. A gateway gives a status only where the rules give it this reading.
        """
        if not self.meters:
            return False
        gateway, order = message.header.sender, message.header.order
        allowed = self._rules.meters_of(gateway)
        columns = message.meters, message.values, message.times, message.valid
        for meter_id, value, time, is_valid in zip(*columns, strict=True):
            if meter_id not in self.meters or (allowed != "all" and meter_id not in allowed):
                continue
            read = self._read.setdefault(self.meters[meter_id], {})
            newer = time, order
            if time <= wall + self._lead_s and (
                gateway not in read or replaces(newer, read[gateway][0], wall, self._lead_s)
            ):
                read[gateway] = newer, read_status(value) if is_valid else UNKNOWN
        return self._decide()

    def _decide(self) -> bool:
        before, self.unknown = dict(self.closed), {}
        for switch in self._ordered.keys() | self._read.keys():
            read = {f"gateway {name} reads": status for name, (_, status) in self._read.get(switch, {}).items()}
            told = {ORDERED: self._ordered[switch]} | read if switch in self._ordered else read
            known = {status for status in told.values() if status != UNKNOWN}
            if len(known) == 1:
                self.closed |= read_statuses(dict.fromkeys([switch], *known))
            else:
                self.unknown[switch] = ", ".join(f"{source} {status}" for source, status in sorted(told.items()))
        return self.closed != before
