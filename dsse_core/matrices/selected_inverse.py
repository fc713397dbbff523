"""Entries of the inverse of a sparse matrix from its LU factors, in about the time of the factorisation.

The entries of ``Z = (L U)^-1`` at the transposed places of L + U follow from one another, from the last pivot to the
first, and from no other entries (Erisman and Tinney, On computing certain elements of the inverse of a sparse matrix,
Communications of the ACM 18 (3), 1975).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

WRONG = 1e-9  # largest difference of a row of Z times a column of A from 1
MOST_PRODUCTS = 20_000_000  # of entries of L and U; about 1 GiB


def find_inverse_entries(A: sp.csc_array, lu: spla.SuperLU, rows: np.ndarray, columns: np.ndarray) -> np.ndarray | None:
    """The entries (rows[k], columns[k]) of A^-1, shape (k,), from the factors of ``A``.

    None where the factors are too full, or not accurate enough. Entries far from those of A and its factors make the
    factors fuller.
    """
    n = A.shape[0]
    row_of, column_of = lu.perm_r.astype(np.int64), lu.perm_c.astype(np.int64)
    entries = A.tocoo()
    entries.eliminate_zeros()
    there = row_of[entries.coords[0]] * n + column_of[entries.coords[1]]
    wanted = row_of[columns] * n + column_of[rows]
    lower, upper = sp.coo_array(lu.L), sp.coo_array(lu.U)
    in_lower, in_upper = _places(lower), _places(upper)
    places = Places.closed(_sort([in_lower, in_upper, there, wanted]), n)
    if places is None:
        return None
    value = np.zeros(len(places.key))
    value[places.find(in_lower)] = lower.data  # the diagonal of U comes on top of that of L
    value[places.find(in_upper)] = upper.data
    Z = _invert(places, value)
    of_rows = np.bincount(entries.coords[1], Z[places.find(there)] * entries.data, n)
    if not abs(of_rows - 1).max() <= WRONG:
        return None
    return np.asarray(Z[places.find(wanted)])


class Places:
    """Places (row, column) in L + U, closed under elimination; ``key``: row n + column, ascending.

    ``below``, ``right``: positions in ``key`` of the entries below a pivot and right of it, pivot by pivot.
    ``product``: positions of the entries where the row of an entry of ``below`` meets the column of an entry of
    ``right``. ``first_below[k]``, ``first_right[k]`` and ``first_product[k]`` are the first of pivot k.
    """

    def __init__(self, key: np.ndarray, n: int) -> None:
        self.key, self.n = key, n
        row, column = np.divmod(key, n)
        below, pivots = np.flatnonzero(row > column), np.arange(n + 1)
        self.below = below[np.argsort(column[below], kind="stable")]
        self.right = np.flatnonzero(row < column)
        self.first_below = np.searchsorted(column[self.below], pivots)
        self.first_right = np.searchsorted(row[self.right], pivots)
        self.n_below, n_right = np.diff(self.first_below), np.diff(self.first_right)
        self.first_product = np.concatenate([[0], np.cumsum(self.n_below * n_right)])
        self.product = np.zeros(0, dtype=np.int64)
        self._row, self._column = row, column

    @classmethod
    def closed(cls, key: np.ndarray, n: int) -> Places | None:
        """Places with all that elimination adds, also for entries that cancel; None above MOST_PRODUCTS."""
        closed = _close(key, n)
        if closed is None:
            return None
        places = cls(closed, n)
        places.product = places.find(places._products())
        return places

    def find(self, key: np.ndarray) -> np.ndarray:
        return np.asarray(np.searchsorted(self.key, key))

    def _products(self) -> np.ndarray:
        pivot = np.repeat(np.arange(self.n), np.diff(self.first_product))
        place = np.arange(self.first_product[-1]) - self.first_product[pivot]
        right = self.right[self.first_right[pivot] + place // self.n_below[pivot]]
        below = self.below[self.first_below[pivot] + place % self.n_below[pivot]]
        return np.asarray(self._row[below] * self.n + self._column[right])


def _close(key: np.ndarray, n: int) -> np.ndarray | None:
    """``key`` with all that elimination adds, pivot by pivot, so that each product is looked at once.

    None at the first pivot where the products exceed MOST_PRODUCTS.
    """
    row, column = np.divmod(key, n)
    first = np.searchsorted(row, np.arange(n + 1)).tolist()
    columns = column.tolist()
    in_row = [set(columns[k:following]) for k, following in pairwise(first)]
    below: list[list[int]] = [[] for _ in range(n)]  # rows of the entries below each pivot
    for i, j in zip(*(part[row > column].tolist() for part in (row, column)), strict=True):
        below[j].append(i)
    products, added = 0, []
    for k in range(n):
        right = {j for j in in_row[k] if j > k}
        products += len(right) * len(below[k])
        if products > MOST_PRODUCTS:
            return None
        for i in below[k]:
            new = right - in_row[i]
            in_row[i] |= new
            for j in new:
                added.append(i * n + j)
                if j < i:
                    below[j].append(i)
    return _sort([key, np.array(added, dtype=np.int64)])


def _sort(keys: list[np.ndarray]) -> np.ndarray:
    """Every key once, ascending; ``np.unique`` takes far longer where many keys are equal."""
    key = np.sort(np.concatenate(keys))
    return np.asarray(key[np.append(True, key[1:] != key[:-1])])


def _places(factor: sp.coo_array) -> np.ndarray:
    row, column = (index.astype(np.int64) for index in factor.coords)
    return np.asarray(row * factor.shape[0] + column)


def _invert(places: Places, value: np.ndarray) -> np.ndarray:
    """Entries of Z at the transposed ``places``; ``value``: L below the diagonal, U on it and above."""
    n = places.n
    at_pivot = places.find(np.arange(n) * (n + 1))
    pivot = value[at_pivot]
    lower = value[places.below]
    upper = value[places.right] / np.repeat(pivot, np.diff(places.first_right))
    below, right, product = places.first_below.tolist(), places.first_right.tolist(), places.first_product.tolist()
    Z = np.zeros(len(value))
    for k in range(n - 1, -1, -1):
        b, r = slice(below[k], below[k + 1]), slice(right[k], right[k + 1])
        block = Z[places.product[product[k] : product[k + 1]]].reshape(r.stop - r.start, b.stop - b.start)
        column = -(block @ lower[b])
        Z[places.right[r]] = column
        Z[places.below[b]] = -(upper[r] @ block)
        Z[at_pivot[k]] = 1 / pivot[k] - upper[r] @ column
    return Z
