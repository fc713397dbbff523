"""The arrays of messages about a boundary: their lengths, which follow from its variables, and R as its upper triangle.

R, shape (d, d), is the square root of an information. A message has its d (d + 1) / 2 numbers from the diagonal on.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np

from agents.messages.checks import Name, Number
from dsse_core.grid.boundary import Boundary

OfRound = Annotated[tuple[Number, ...], "in a message an exact 0 is an integer, of one byte"]
Variables = Annotated[tuple[Name, ...], "of a boundary, in a message its powers, from which the voltages follow"]
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


@functools.cache
def _upper(d: int) -> np.ndarray:
    """Indices of these numbers in ``R.ravel()``, row by row."""
    return np.flatnonzero(np.triu(np.ones((d, d))))


def write_triangle(R: np.ndarray) -> tuple[float, ...]:
    return tuple(R.ravel()[_upper(len(R))].tolist())


def read_triangle(numbers: Sequence[float]) -> np.ndarray:
    """R, shape (d, d)."""
    d = (math.isqrt(8 * len(numbers) + 1) - 1) // 2
    R = np.zeros(d * d)
    R[_upper(d)] = numbers
    return R.reshape(d, d)
