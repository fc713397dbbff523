"""Growth of a figure with size, apart from its constant part."""

from __future__ import annotations

import math
from collections.abc import Sequence

STEEPEST = 6.0
LEAST_GROWTH = 0.05  # from the first of three points to the second, of the first: less is chance


def find_exponent(sizes: Sequence[int], figures: Sequence[float]) -> float | None:
    """The k of ``a + b n^k`` through the last three points, whose start-up ``a`` cancels; None if there is no such
    k.
    """
    if len(sizes) < 3 or len(sizes) != len(figures):
        return None
    (n1, n2, n3), (f1, f2, f3) = sizes[-3:], figures[-3:]
    if not (f1 * (1 + LEAST_GROWTH) < f2 < f3):
        return None
    wanted = (f3 - f2) / (f2 - f1)

    def ratio(k: float) -> float:
        return float((n3**k - n2**k) / (n2**k - n1**k))

    low, high = 1e-3, STEEPEST
    if not ratio(low) < wanted < ratio(high):
        return None
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (middle, high) if ratio(middle) < wanted else (low, middle)
    return low


def find_n_log_n(sizes: Sequence[int]) -> float | None:
    """The exponent that ``n log n`` has through the same points."""
    return find_exponent(sizes, [n * math.log(n) for n in sizes])
