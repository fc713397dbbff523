"""Lengths of the arrays in messages about a boundary, which follow from its variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dsse_core.grid.boundary import Boundary

Lengths = Mapping[str, tuple[int, Sequence[int]]]
"""Field of a message -> how many numbers it has, and how many it may have."""


def count_triangle(d: int) -> int:
    """The numbers of a square root R, shape (d, d), that is upper triangular."""
    return d * (d + 1) // 2


def find_wrong_length(boundary: Boundary, lengths: Lengths) -> str:
    """The first of ``lengths``, name -> (found, possible), that is not possible with the variables of ``boundary``."""
    for name, (found, possible) in lengths.items():
        if found not in possible:
            expected = " or ".join(map(str, possible))
            return f"{name} has {found} numbers, not {expected}, with {boundary.d} variables"
    return ""
