"""Zero, positive and negative sequences of other projects' elements, as matrices between phases."""

from __future__ import annotations

import cmath
import math

import numpy as np

ABC = "abc"
TURN = cmath.exp(2j * math.pi / 3)
OF_SEQUENCES = np.array([[1, 1, 1], [1, TURN**2, TURN], [1, TURN, TURN**2]])
"""Phases of the zero, positive and negative sequence."""


def join_sequences(of_sequence: np.ndarray) -> np.ndarray:
    """The admittances between phases of an element with n ends, (3 n, 3 n), from those of each sequence, (3, n, n)."""
    n = of_sequence.shape[1]
    blocks = np.einsum("is,smn,sj->minj", OF_SEQUENCES, of_sequence, np.linalg.inv(OF_SEQUENCES))
    Y = blocks.reshape(3 * n, 3 * n)
    return np.asarray((Y + Y.T) / 2)


def spread(positive: complex, zero: complex) -> np.ndarray:
    """The matrix between phases of a positive and negative, and a zero sequence, (3, 3)."""
    return positive * np.eye(3) + (zero - positive) / 3
