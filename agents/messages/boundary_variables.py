"""The variables y of a boundary that messages are about: how many, of which kinds and phases.

A variable is called by its kind, then ``@`` and the bus where the boundary has several, then ``.`` and the phase where
it has several: ``p``, ``vm.a``, ``va@12``. All lengths in a message follow from their number d.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence

ONE_PHASE = ("p", "q", "vm", "va")  # one bus, one phase: d = 4, all that the estimation knows today
MOST_VARIABLES = 1000
NAME = re.compile(r"(?P<kind>[a-z]{1,8})(@-?[0-9]{1,16})?(\.[a-z]{1,8})?")
Lengths = Mapping[str, tuple[int, Sequence[int]]]
"""Field of a message -> how many numbers it has, and how many it may have."""
POWERS = ("p", "q")  # kinds of which the child of a boundary sends the parent the value at x_k


def count_triangle(d: int) -> int:
    """The numbers of a square root R, shape (d, d), that is upper triangular."""
    return d * (d + 1) // 2


@functools.lru_cache(maxsize=64)
def find_wrong_variable(variables: tuple[str, ...]) -> str:
    """What no boundary can have among its ``variables``; empty if it can have them."""
    if not 0 < len(variables) <= MOST_VARIABLES:
        return f"{len(variables)} variables, not 1 to {MOST_VARIABLES}"
    if len(set(variables)) < len(variables):
        return "a variable given twice"
    return next((f"variable {name[:40]!a}" for name in variables if not NAME.fullmatch(name)), "")


@functools.lru_cache(maxsize=64)
def count_powers(variables: tuple[str, ...]) -> int:
    """How many of ``variables`` are powers."""
    kinds = [found["kind"] for name in variables if (found := NAME.fullmatch(name))]
    return sum(kind in POWERS for kind in kinds)


def find_wrong_length(variables: Sequence[str], lengths: Lengths) -> str:
    """The first of ``lengths``, name -> (found, possible), that is not possible with so many ``variables``."""
    for name, (found, possible) in lengths.items():
        if found not in possible:
            expected = " or ".join(map(str, possible))
            return f"{name} has {found} numbers, not {expected}, with {len(variables)} variables"
    return ""
