"""The upper triangle of a square root of information, R (d, d), as the d (d + 1) / 2 numbers of a message."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np


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
