"""The upper triangle of a square root of information, R (4, 4), as the ten numbers of a message."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_UPPER = np.flatnonzero(np.triu(np.ones((4, 4))))  # of R row by row


def write_triangle(R: np.ndarray) -> tuple[float, ...]:
    return tuple(R.ravel()[_UPPER].tolist())


def read_triangle(numbers: Sequence[float]) -> np.ndarray:
    """R, shape (4, 4)."""
    R = np.zeros(16)
    R[_UPPER] = numbers
    return R.reshape(4, 4)
