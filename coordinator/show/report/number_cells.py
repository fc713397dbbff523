"""Columns of numbers as text, all at once: cells are columns of characters, of equal width, flush right.

The text of a number equals that of ``%`` to the last digit. The number is scaled to a whole number first. Where the
product is so near to a half that its rounding error could decide, or the number is too large, ``%`` itself writes it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

BLANK, ZERO, MINUS, POINT = b" 0-."
MOST_WHOLE = 1e15  # of a scaled number; up to here its rounding is known
ROUNDING = 4 * np.finfo(float).eps  # relative error of a scaled number: more than that of a product
LEAST_DECADE = -4  # below 1e-4 %g writes an exponent
POWERS = np.array([float(f"1e{k}") for k in range(LEAST_DECADE, 16)])


def write_fixed(values: np.ndarray, digits: int) -> np.ndarray:
    """Text ``%.{digits}f`` of ``values`` (n,): characters (width, n), uint8."""
    whole, known = _round(values, digits)
    cells = _write_whole(np.where(known, whole, 0).astype(np.int64), np.signbit(values), digits)
    return _overwrite(cells, ~known, f"%.{digits}f", values)


def write_significant(values: np.ndarray, digits: int) -> np.ndarray:
    """Text ``%.{digits}g`` of ``values`` (n,): characters (width, n), uint8."""
    decade = np.searchsorted(POWERS, abs(values), side="right") - 1 + LEAST_DECADE
    known = (decade >= LEAST_DECADE) & (decade < digits)
    decimals = np.where(known, digits - 1 - decade, 0)
    whole, is_sure = _round(values, decimals)
    known &= is_sure & ((whole < 10**digits) | (decimals > 0))  # 9999.6 becomes 1e+04
    number = np.where(known, whole, 0).astype(np.int64)
    for _ in range(digits):
        ends_in_zero = known & (decimals > 0) & (number % 10 == 0)
        number, decimals = np.where(ends_in_zero, number // 10, number), decimals - ends_in_zero
    cells = np.empty((0, len(values)), dtype=np.uint8)
    for count in np.unique(decimals[known]).tolist():
        here = known & (decimals == count)
        cells = place(cells, here, _write_whole(number[here], np.signbit(values[here]), count))
    return _overwrite(cells, ~known, f"%.{digits}g", values)


def write_texts(texts: Sequence[str]) -> np.ndarray:
    """Characters (width, n) of ``texts``, flush left; uint8 or, where a text is not ASCII, uint32."""
    as_bytes = "".join(texts).isascii()
    table = np.array(texts or [""], dtype=np.bytes_ if as_bytes else np.str_)
    cells = table.view(np.uint8 if as_bytes else np.uint32).reshape(len(table), -1)[: len(texts)].T
    return np.where(cells == 0, cells.dtype.type(BLANK), cells)


def place(cells: np.ndarray, here: np.ndarray, part: np.ndarray) -> np.ndarray:
    """``cells`` (width, n), widened to the width of ``part`` (width, k), with ``part`` in the k columns ``here``."""
    missing = len(part) - len(cells)
    if missing > 0:
        cells = np.concatenate([np.full((missing, cells.shape[1]), BLANK, dtype=np.uint8), cells])
    cells[:, here] = BLANK
    cells[len(cells) - len(part) :, here] = part
    return cells


def _round(values: np.ndarray, digits: np.ndarray | int) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of ``values`` (n,) in units of the last of ``digits`` after the point, and a mask of those surely right."""
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = abs(values) * 10.0 ** np.asarray(digits)
        to_half = abs(scaled - np.floor(scaled) - 0.5)
        return np.rint(scaled), (scaled < MOST_WHOLE) & (to_half > ROUNDING * np.maximum(scaled, 1.0))


def _write_whole(number: np.ndarray, is_negative: np.ndarray, digits: int) -> np.ndarray:
    """``number`` (n,), int64, with a point before its last ``digits``: characters (width, n)."""
    largest = int(number.max(initial=0))
    count = max(len(str(largest)), digits + 1)  # of digits
    number = number.astype(np.int32) if largest < 2**31 else number
    cells = np.full((1 + count + (digits > 0), len(number)), BLANK, dtype=np.uint8)
    row, length = len(cells) - 1, np.full(len(number), digits + 1 + (digits > 0))
    for k in range(count):
        following = number // 10
        if k <= digits:
            cells[row] = number - 10 * following + ZERO
        else:
            cells[row] = np.where(number > 0, number - 10 * following + ZERO, BLANK)
            length += number > 0
        row, number = row - 1, following
        if k == digits - 1:
            cells[row], row = POINT, row - 1
    negative = np.flatnonzero(is_negative)
    cells[len(cells) - 1 - length[negative], negative] = MINUS
    return cells if (cells[0] != BLANK).any() else cells[1:]


def _overwrite(cells: np.ndarray, here: np.ndarray, form: str, values: np.ndarray) -> np.ndarray:
    """``cells`` with the text by ``%`` of those of ``values`` in the mask ``here``."""
    if not here.any():
        return cells
    texts = [form % value for value in values[here].tolist()]
    width = max(map(len, texts))
    return place(cells, here, write_texts([text.rjust(width) for text in texts]))
