"""Order of two messages of a sender, and the age up to which a message counts as fresh.

All orders and ages of the protocol are in a table of docs/explanation/protocol.md (orders and ages).

Ages count by the area's own clock, from the moment of arrival. The send time that a message states does not make it
fresh: a paused process or a slow link may have delivered it late.
"""

from __future__ import annotations

from typing import Any, TypeVar

Order = TypeVar("Order", bound=Any)
"""Order of the messages of a sender: incarnation and sequence number, or the number within an incarnation."""
FRESH_HEARTBEATS = 3  # younger is fresh: at rest there is a heartbeat in every interval, and two in a row may be lost
PASSED_ON_HEARTBEATS = FRESH_HEARTBEATS + 0.5  # older is not passed on as fresh; the third heartbeat may be late
PATIENCE_HEARTBEATS = 8  # of silence after which a process counts as gone, and its incarnation as over, at least


def is_old(order: Order, last: Order, silence_s: float, over_s: float) -> bool:
    """True where the message of order ``last``, not received for ``silence_s``, is newer: a later one of the same
    incarnation, or one of a later incarnation.

    An incarnation that was silent for more than ``over_s`` is over: no message is old beside it. The clock of the next
    incarnation may have been set back, and a number that its sender does not repeat came from another process.
    """
    return bool(order < last) and silence_s <= over_s


def is_newer(order: Order, last: Order, silence_s: float, over_s: float) -> bool:
    """True where a message is neither old beside the ``last`` one, see ``is_old``, nor the same again."""
    return bool(order != last) and not is_old(order, last, silence_s, over_s)
