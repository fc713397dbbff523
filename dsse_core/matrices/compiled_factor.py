"""LU factors by compiled elimination, whose pattern and pivots serve for further matrices of one pattern."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from dsse_core.matrices.elimination import (
    check_inverse,
    eliminate,
    eliminate_again,
    find_places,
    invert,
    sort_rows,
    substitute,
)
from dsse_core.matrices.selected_inverse import WRONG

KEPT = 0.1  # least pivot for another matrix of the same pattern, in parts of the least pivot of an elimination


@dataclass(frozen=True, repr=False)
class Elimination:
    """The pattern of F, and its pivots; see ``elimination``."""

    first: np.ndarray
    rows: np.ndarray
    diagonal: np.ndarray
    number: np.ndarray


@dataclass(frozen=True, repr=False)
class CompiledFactor:
    """LU factors of a matrix (n, n); ``values``: the entries of F."""

    elimination: Elimination
    values: np.ndarray

    def solve(self, b: np.ndarray) -> np.ndarray:
        """The solution, shape of ``b``: (n,) or (n, n_right)."""
        e = self.elimination
        columns = np.ascontiguousarray(b.reshape(len(b), -1), dtype=float)
        found: np.ndarray = substitute(e.first, e.rows, e.diagonal, e.number, self.values, columns).reshape(b.shape)
        return found

    def find_inverse(self, A: sp.csc_array, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The entries (rows[k], columns[k]) of the inverse of ``A``, and True for those that may have lost digits.

        Both have the shape (k,). These are the factors of ``A``, which is symmetric. Entries whose transposed places F
        does not have are nan.
        """
        e = self.elimination
        Z = invert(e.first, e.rows, e.diagonal, self.values)
        miss = check_inverse(e.first, e.rows, e.number, Z, A.indptr, A.indices, A.data)
        place = find_places(e.first, e.rows, e.number, columns, rows)
        wrong = ~(np.maximum(miss[rows], miss[columns]) <= WRONG)
        return np.where(place < 0, np.nan, Z[place]), wrong


def factor_compiled(A: sp.csc_array, pivot: float, known: Elimination | None = None) -> CompiledFactor:
    """The factors of A; by the pivots ``known`` of a matrix of the same pattern, where they serve.

    ``pivot``: least size of a pivot, in parts of the largest entry left in its column.

    Raises:
        RuntimeError: A is exactly singular.
    """
    n = A.shape[0]
    if known is not None:
        values, count = eliminate_again(*_parts(known), A.indptr, A.indices, A.data, KEPT * pivot)
        if count == n:
            return CompiledFactor(known, values)
    first, rows, values, number = eliminate(A.indptr, A.indices, A.data, pivot)
    if (number < 0).any():
        raise RuntimeError("the matrix is exactly singular")
    rows, values, diagonal = sort_rows(first, rows, values, number)
    return CompiledFactor(Elimination(first, rows, diagonal, number), values)


def _parts(e: Elimination) -> tuple[np.ndarray, ...]:
    return e.first, e.rows, e.diagonal, e.number
