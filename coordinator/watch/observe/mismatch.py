"""Differences of the voltages that two areas publish at the buses that both see."""

from __future__ import annotations

import math
from collections.abc import Iterable

from agents.messages.packing import StateMessage


def find_mismatches(
    buses: Iterable[int], one: StateMessage, other: StateMessage
) -> dict[tuple[int, str], tuple[float, float]]:
    """Bus and phase -> differences of magnitude and (wrapped) angle, p.u. and rad, at the nodes that both states have.

    The phase is "" in a balanced network.
    """
    found = {}
    for bus in buses:
        theirs = other.phases_at(bus)
        for phase in one.phases_at(bus):
            if phase in theirs:
                i, j = one.row_of(bus, phase), other.row_of(bus, phase)
                va = math.remainder(one.va[i] - other.va[j], 2 * math.pi)
                found[bus, phase] = abs(one.vm[i] - other.vm[j]), abs(va)
    return found
