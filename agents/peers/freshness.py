"""How long what was last received counts as fresh, and which of two messages of a sender is the newer one.

Ages are by the area's own clock, from the moment of arrival: what a paused process or a slow link brings late is not
young because it says so.
"""

from __future__ import annotations

from agents.messages.packing import Header

FRESH_HEARTBEATS = 3  # younger is fresh: at rest there is a heartbeat in every interval, and two in a row may be lost
PASSED_ON_HEARTBEATS = 3.5  # older is not passed on as fresh; the third heartbeat, just after three heartbeats, may be
PATIENCE_HEARTBEATS = 8  # of silence after which a process counts as gone, and its incarnation as over, at least


def is_old(header: Header, last: Header, silence_s: float, over_s: float) -> bool:
    """Whether ``last``, not received for ``silence_s``, is newer: a later message of its incarnation, or of a later
    one.

    One that was silent for more than ``over_s`` is over: the clock of the next one may have been set back, and a number
    that its sender does not repeat was somebody else's.
    """
    return header.order < last.order and silence_s <= over_s
