"""Freshness: the time for which a received message counts as fresh, and the order of two messages of a sender.

Ages count by the area's own clock, from the moment of arrival. The send time that a message states does not make it
fresh: a paused process or a slow link may have delivered it late.
"""

from __future__ import annotations

from agents.messages.packing import Header

FRESH_HEARTBEATS = 3  # younger is fresh: at rest there is a heartbeat in every interval, and two in a row may be lost
PASSED_ON_HEARTBEATS = 3.5  # older is not passed on as fresh; the third heartbeat, just after three heartbeats, may be
PATIENCE_HEARTBEATS = 8  # of silence after which a process counts as gone, and its incarnation as over, at least


def is_old(header: Header, last: Header, silence_s: float, over_s: float) -> bool:
    """True where ``last``, not received for ``silence_s``, is newer: a later message of the same incarnation, or a
    message of a later one.

    An incarnation that was silent for more than ``over_s`` is over: no message is old beside it. The clock of the next
    incarnation may have been set back, and a number that its sender does not repeat came from another process.
    """
    return header.order < last.order and silence_s <= over_s
