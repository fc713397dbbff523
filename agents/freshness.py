"""Whether all that a word to a neighbour rests on is fresh: said along with it, so that it is known in the whole tree.

It says nothing of the numbers, which stay as true as they were, and makes nobody solve. A change is told at once at
rest, under the number of the word that it belongs to, and with each repeat; what repeats tell is told until it holds
no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from agents.hearing import PASSED_ON_BEATS, Hearing
from agents.messages import BoundaryNews


def find_fresh(hearing: Hearing, neighbours: Sequence[str], gone: set[str], now: float) -> dict[str, bool]:
    """Neighbour -> whether the own telemetry, and all that is behind the other neighbours, is of the scan and fresh.

    ``gone``: the neighbours whose processes have ended. None of the neighbours' words comes back to the one who said
    it, and the areas are a tree: nobody stays fresh, or old, because he hears so of himself.
    """
    if hearing.is_late(now, PASSED_ON_BEATS):
        return dict.fromkeys(neighbours, False)
    old = hearing.find_old(neighbours, now, PASSED_ON_BEATS) | gone
    return {name: old <= {name} for name in neighbours}


def renew(message: BoundaryNews, fresh: bool, time: float) -> BoundaryNews:
    """``message`` under its number, with what holds at ``time``."""
    return replace(message, header=replace(message.header, time=time), fresh=fresh)
