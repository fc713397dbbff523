"""The weighted least-squares step in augmented form (Hachtel's tableau), sparse.

The normal equations ``H'WH dx = H'W r`` square the condition number: with sigmas over four decades or an
impedance of 1e-5 p.u. they lose every digit of Omega. The same step follows from

``[a R  H ] [ s]   [r]``
``[ H'  0 ] [dx] = [0]``  with ``R = diag(sigma^2)``,

where a virtual measurement is a row with sigma = 0, that is, an equality constraint. The factor ``a`` only
scales ``s``; it makes the factorisation choose good pivots (Bjorck, Numerical Methods for Least Squares
Problems, 2.7).
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from dsse_core.compiling import find_obstacle
from dsse_core.matrices.block_tree import BlockTree, find_block_tree
from dsse_core.matrices.selected_inverse import find_inverse_entries

if TYPE_CHECKING:
    from dsse_core.matrices.compiled_factor import CompiledFactor, Elimination

PIVOT_SCALE = 1e-3  # median of the scaled a R; anything from 1 to 1e-6 works, with fewer digits at the ends
LARGEST_DAMPING = 1e-6  # of the scaled tableau
NEARBY = 1e-7  # relative accuracy of a step on the factor of a state nearby
ROUND_OFF = 1e-14  # p.u. and rad; no step need be more accurate
CONTRACTION = 0.3  # of a correction to the one before; where they shrink less a new factor costs less
MOST_REFINEMENTS = 5
# Options of SuperLU where the order of elimination is given: little pivoting, which refinement makes up for, and no
# supernodes, as those of these tableaus are not worth it.
ORDERED = {"diag_pivot_thresh": 1e-3, "relax": 1, "panel_size": 1, "options": {"SymmetricMode": True}}
KEPT_PIVOT = 1e-6  # in place of 1e-3 where a moved pivot fills in: least pivot, in parts of its column's largest entry
REFINED = 1e-6  # largest correction relative to a solution; the error left is its square; else pivots are moved
# Rows of the tableau from which on elimination in a given order is compiled: with 500 buses loading numba pays.
FEWEST_COMPILED = 2500
PIVOT = 0.1  # least pivot of a compiled elimination without fill-in, in parts of the largest entry left in the column
PIVOT_FILLING_IN = 1e-3  # the same with fill-in, as a moved pivot fills in more
ROWS_OF_A_BUS = 6  # about: two of voltages, and its meters
FEWEST_SELECTED = 400  # rows of the tableau from which on the selected inverse takes less than solves
MOST_SOLVED = 100_000_000  # rows of the tableau times right-hand sides: some ten seconds
FEW_SOLVED = 256  # right-hand sides, where MOST_SOLVED does not allow all
BLOCK = 256  # right-hand sides, or variances, found at once; bounds memory at BLOCK times the size of the system


class AugmentedPattern:
    """Places of the entries of the tableau, the same for all ``H`` with one pattern.

    ``columns`` (n_state,): the columns of H whose variables are unknown; all without it. ``order`` (n_meas + n_state,):
    the tableau's rows in the order of elimination; SuperLU's COLAMD without it. ``joined``: pairs of unknowns, (k,)
    each, whose entries of 0 the tableau has, so that compiled elimination finds those of the inverse.
    ``fills_in``: the factor in that order is fuller than the tableau. ``careful``: pivots are the largest, by SuperLU,
    so that no digit is lost, rather than those that fill in least. ``blocks`` (n_meas + n_state,): the block of each
    row in that order, where blocks make a tree. ``place`` (n_meas + n_state,): place of each row of the tableau in that
    order.
    """

    def __init__(
        self,
        H: sp.csr_array,
        columns: np.ndarray | None = None,
        *,
        order: np.ndarray | None = None,
        fills_in: bool = False,
        careful: bool = False,
        blocks: np.ndarray | None = None,
        joined: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self.order, self.fills_in, self._careful, self._blocks = order, fills_in, careful, blocks
        self.columns = np.arange(H.shape[1]) if columns is None else columns
        self._indices, self._indptr = H.indices, H.indptr
        self._size = H.shape[0] + len(self.columns)
        of_column = np.full(H.shape[1], -1, dtype=np.int32)
        of_column[self.columns] = np.arange(len(self.columns))
        self.row, self.column = _row_of_entries(H), of_column[H.indices]
        self.known, unknown = np.flatnonzero(self.column < 0), np.flatnonzero(self.column >= 0)  # entries by columns
        self.column[self.known] = 0  # any number
        self.place = place = np.arange(self._size)
        if order is not None:
            place[order] = np.arange(self._size)
        row, column = place[self.row[unknown]], place[H.shape[0] + self.column[unknown]]
        a, b = (place[H.shape[0] + of_pair] for of_pair in joined or (place[:0], place[:0]))
        at = np.concatenate([place, row, column, a, b]), np.concatenate([place, column, row, b, a])
        of_H = self._size + unknown
        number = np.concatenate([np.arange(self._size), of_H, of_H, np.full(2 * len(a), -1)])
        shape = self._size, self._size
        numbers = sp.csc_array((number, at), shape=shape)  # no two in one place
        numbers.sort_indices()
        self._gather, values = numbers.data, np.zeros(len(number))
        self._empty = sp.csc_array((values, numbers.indices, numbers.indptr), shape=shape)

    def fits(self, H: sp.csr_array) -> bool:
        """True where H has this pattern."""
        if H.indices is self._indices and H.indptr is self._indptr:
            return True
        return np.array_equal(H.indptr, self._indptr) and np.array_equal(H.indices, self._indices)

    @cached_property
    def is_compiled(self) -> bool:
        """True where elimination in this order is compiled; decided once, on the first call."""
        can_pay = self.order is not None and self._size >= FEWEST_COMPILED and not self._careful
        return can_pay and find_obstacle("sparse", self._size // ROWS_OF_A_BUS) is None

    @cached_property
    def tree(self) -> BlockTree | None:
        return None if self._blocks is None else find_block_tree(self._empty, self._blocks)

    def fill(self, above: np.ndarray, data: np.ndarray, below: np.ndarray) -> sp.csc_array:
        """``[[diag(above), H], [H', diag(below)]]`` in the order of elimination, ``data`` the entries of H."""
        return self._with_values(np.concatenate([above, below, data, [0.0]])[self._gather])

    def fill_scaled(self, above: np.ndarray, H: sp.csr_array, below: np.ndarray, scale: np.ndarray) -> sp.csc_array:
        """``fill`` with the rows and columns of H times ``scale`` (n_meas + n_state,)."""
        n_meas = H.shape[0]
        if not self.is_compiled:
            data = H.data * scale[:n_meas][self.row] * scale[n_meas:][self.column]
            return self.fill(above, data, below)
        from dsse_core.matrices.elimination import fill_tableau  # numba

        return self._with_values(fill_tableau(self._gather, above, below, H.data, self.row, self.column, scale))

    def put_below(self, tableau: sp.csc_array, first: int, below: np.ndarray) -> None:
        """Puts ``below`` on the diagonal of the tableau, from row ``first`` on."""
        at = np.flatnonzero((self._gather >= first) & (self._gather < first + len(below)))
        tableau.data[at] = below[self._gather[at] - first]

    def _with_values(self, values: np.ndarray) -> sp.csc_array:
        """The tableau with these entries; a new one would have its indices checked each time."""
        tableau = copy.copy(self._empty)
        tableau.data = values
        return tableau

    def permute(self, b: np.ndarray) -> np.ndarray:
        """Rows of ``b`` in the order of elimination."""
        return b if self.order is None else b[self.order]

    def permute_back(self, b: np.ndarray) -> np.ndarray:
        if self.order is None:
            return b
        there = np.empty_like(b)
        there[self.order] = b
        return there

    def factor(self, tableau: sp.csc_array, known: Elimination | None = None) -> spla.SuperLU | CompiledFactor:
        """Factor of the tableau for most steps and variances; ``known``: elimination of a tableau nearby.

        Raises RuntimeError where the tableau is exactly singular.
        """
        if not self.is_compiled:
            return self.factor_by_superlu(tableau, exact=self._careful)
        from dsse_core.matrices.compiled_factor import factor_compiled  # numba

        return factor_compiled(tableau, PIVOT_FILLING_IN if self.fills_in else PIVOT, known)

    def factor_by_superlu(self, tableau: sp.csc_array, *, exact: bool = False) -> spla.SuperLU:
        """Factor of the tableau by SuperLU; ``exact``: with full pivoting, so that refinement is not needed.

        Raises RuntimeError where the tableau is exactly singular.
        """
        if self.order is None or (exact and self.fills_in):  # moved pivots spoil the order, and COLAMD expects them
            return spla.splu(tableau)
        changed = {"diag_pivot_thresh": 1.0} if exact else {"diag_pivot_thresh": KEPT_PIVOT} if self.fills_in else {}
        return spla.splu(tableau, permc_spec="NATURAL", **(ORDERED | changed))


class AugmentedFactor:
    """The factorised system for ``H`` (n_meas, n) and ``sigma`` (n_meas,), 0 where a row must hold exactly.

    ``damping``, a number or one per state variable, is added to the diagonal of the information about the state:
    the lower right block becomes ``-diag(damping)``. ``pattern``: pattern of H, if it is known already.
    ``variance`` (n_meas,): sigma squared. ``n_state``: unknowns. ``nearby``: a factor whose pivots may serve.
    ``no_rounding``: entries of H have none, so that a singular pivot is exactly 0 and the least damping tells.

    All but the constructor raise RuntimeError where the matrix is exactly singular and damping does not help.
    """

    def __init__(
        self,
        H: sp.csr_array,
        sigma: np.ndarray,
        damping: float | np.ndarray = 0.0,
        pattern: AugmentedPattern | None = None,
        nearby: AugmentedFactor | None = None,
        *,
        no_rounding: bool = False,
    ) -> None:
        self._no_rounding = no_rounding
        self._pattern = pattern = pattern or AugmentedPattern(H)
        self._n_meas, self.n_state = H.shape[0], len(pattern.columns)
        self.variance, self._damping = sigma**2, np.broadcast_to(damping, self.n_state)
        square = H.data**2
        square[pattern.known] = 0.0
        row_scale = reciprocal_root(np.bincount(pattern.row, square, self._n_meas))
        squared = row_scale**2
        scaled_variance = self.variance * squared
        positive = scaled_variance[scaled_variance > 0]
        middle = positive.size // 2  # np.median takes three times as long
        self._a = PIVOT_SCALE / float(np.partition(positive, middle)[middle]) if positive.size else 1.0
        square *= squared[pattern.row]
        of_columns = np.bincount(pattern.column, square, self.n_state)
        column_scale = reciprocal_root(of_columns + damping / self._a)
        self._scale = np.concatenate([row_scale, column_scale])
        self._above = self._a * scaled_variance
        self._below = damping / self._a * column_scale**2
        self._tableau, self._known = self._fill(H), nearby.elimination if nearby else None

    @cached_property
    def _lu(self) -> spla.SuperLU | CompiledFactor:
        """LU factors, found where they are first needed: entries of the inverse on a tree of blocks need none."""
        while True:
            try:
                return self._pattern.factor(self._tableau, self._known)
            except RuntimeError:  # exactly singular
                self._raise_damping()

    def _raise_damping(self) -> None:
        self._below = raise_damping(self._below)
        self._pattern.put_below(self._tableau, self._n_meas, -self._below)

    @property
    def elimination(self) -> Elimination | None:
        """The compiled elimination; None where SuperLU has factorised."""
        return None if isinstance(self._lu, spla.SuperLU) else self._lu.elimination

    def _fill(self, H: sp.csr_array) -> sp.csc_array:
        return self._pattern.fill_scaled(self._above, H, -self._below, self._scale)

    def solve_nearby(self, H: sp.csr_array, above: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """(s, dx) of ``solve(above, 0)`` for another H of the same pattern, by refinement with this factor.

        Refinement begins at the given ``s``, such as the last one, and ends where dx is accurate to NEARBY of itself or
        to ROUND_OFF. None where the two H are too far apart for that.
        """
        tableau, m = self._fill(H), self._n_meas
        solution = np.concatenate([s / (self._a * self._scale[:m]), np.zeros(self.n_state)])
        rest = self._pattern.permute(self._scale * np.concatenate([above, np.zeros(self.n_state)]))
        correction, last = self._pattern.permute(solution), 0.0
        for k in range(MOST_REFINEMENTS):
            rest = self._rest(rest, tableau, correction)
            correction = self._lu.solve(rest)
            change = self._pattern.permute_back(correction)
            solution += change
            size, whole = (float(abs(self._scale[m:] * part[m:]).max(initial=0.0)) for part in (change, solution))
            rate = size / last if last else 1.0
            if rate * size <= max(NEARBY * whole, ROUND_OFF):  # the correction to come
                return self._a * self._scale[:m] * solution[:m], self._scale[m:] * solution[m:]
            if k and not rate <= CONTRACTION:
                return None
            last = size
        return None

    def solve(self, above: np.ndarray, below: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(s, dx) of ``R s + H dx = above``, ``H's - damping dx = below``; vectors or columns."""
        solution = self._solve(np.concatenate([above, below / self._a]))
        return self._a * solution[: self._n_meas], solution[self._n_meas :]

    def covariance_times(self, B: np.ndarray) -> np.ndarray:
        """``G^-1 B`` (n_state, k), ``G = H'WH`` under the constraints: columns of the state's covariance."""
        return -self.solve(np.zeros((self._n_meas, B.shape[1])), B)[1]

    def root_of_covariance(self, s: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """F with ``F'F = B'G^-1 B``, a sum of squares, from the solution ``s``, ``dx`` of ``solve(0, B)``."""
        return np.vstack([self.variance[:, None] ** 0.5 * s, self._damping[:, None] ** 0.5 * dx])

    def variance_of_sums(self, B: sp.csr_array) -> np.ndarray:
        """diag(B G^-1 B'), shape (k,), for ``B`` (k, n_state); nan where k solves would cost more than MOST_SOLVED."""
        found = np.full(B.shape[0], np.nan)
        if len(self._scale) * B.shape[0] <= MOST_SOLVED:
            for first in range(0, len(found), BLOCK):
                block = B[first : first + BLOCK].toarray()
                found[first : first + BLOCK] = np.einsum("ks,sk->k", block, self.covariance_times(block.T))
        return found

    def state_variance(self, *, limited: bool = False) -> np.ndarray:
        """diag(G^-1), shape (n_state,); ``limited``: nan where the solves for it would cost more than MOST_SOLVED."""
        rows = self._n_meas + np.arange(self.n_state)
        too_many = limited and not self._can_find(len(rows))
        return np.full(len(rows), np.nan) if too_many else self._diagonal(rows) / -self._a

    def covariance_at(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries (rows[k], columns[k]) of G^-1, shape (k,).

        Nan where the selected inverse declines and solves would cost more than MOST_SOLVED.
        """
        rows, columns = self._n_meas + np.asarray(rows), self._n_meas + np.asarray(columns)
        found = self._find_selected(rows, columns)
        if found is None and len(self._scale) * len(np.unique(columns)) > MOST_SOLVED:
            return np.full(len(rows), np.nan)
        return np.asarray((self._solve_entries(rows, columns) if found is None else found) / -self._a)

    def _find_selected(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray | None:
        """Entries of the inverse of the tableau, (k,), without a solution for each column; None where that costs more
        or cannot be.

        They are found by compiled elimination or on a tree, with solutions where digits are lost, if that does and no
        entry is far from all entries of the tableau; else from factors of SuperLU.
        """
        if len(self._scale) < FEWEST_SELECTED:
            return None
        place, fills_in = self._pattern.place, self._pattern.fills_in
        by = self._lu if self._pattern.is_compiled else self._pattern.tree
        if by is not None and not isinstance(by, spla.SuperLU):
            found, wrong = by.find_inverse(self._tableau, place[rows], place[columns])
            if not np.isnan(found).any() and len(self._scale) * len(np.unique(columns[wrong])) <= MOST_SOLVED:
                found *= self._scale[rows] * self._scale[columns]
                if wrong.any():
                    found[wrong] = self._solve_entries(rows[wrong], columns[wrong])
                return np.asarray(found)
        for exact in (
            (True, False) if fills_in else (True,)
        ):  # the latter: fewer entries, accurate enough for most grids
            factor = self._pattern.factor_by_superlu(self._tableau, exact=exact)
            selected = find_inverse_entries(self._tableau, factor, place[rows], place[columns])
            if selected is not None:
                return np.asarray(self._scale[rows] * selected * self._scale[columns])
        return None

    def _solve_entries(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Entries of the inverse of the tableau, a solution for each of the ``columns``."""
        entries, (of_column, which) = np.empty(len(rows)), np.unique(columns, return_inverse=True)
        for first in range(0, len(of_column), BLOCK):
            block = of_column[first : first + BLOCK]
            unit = np.zeros((len(self._scale), len(block)))
            unit[block, np.arange(len(block))] = 1.0
            here = np.flatnonzero((which >= first) & (which < first + len(block)))
            entries[here] = self._solve(unit)[rows[here], which[here] - first]
        return entries

    def residual_variance(self, wanted: np.ndarray | None = None) -> np.ndarray:
        """diag(Omega), ``Omega = R - H G^-1 H'`` (eq. 3.22), shape (n_meas,); found without that cancellation.

        ``wanted`` (n_meas,): rows, the most wanted first. Where solves for all would cost more than MOST_SOLVED the
        first FEW_SOLVED are found, and the others are nan. Without ``wanted`` all are found, however long that takes.
        """
        rows = np.arange(self._n_meas) if wanted is None else np.asarray(wanted)
        if wanted is not None and not self._can_find(len(rows)):
            rows = rows[:FEW_SOLVED]
        variance = np.full(self._n_meas, np.nan)
        variance[rows] = self._a * self.variance[rows] ** 2 * self._diagonal(rows)
        return variance

    def _can_find(self, count: int) -> bool:
        """True where ``count`` entries of the inverse's diagonal cost no more than MOST_SOLVED."""
        return len(self._scale) * count <= MOST_SOLVED or self._inverse_diagonal is not None

    @cached_property
    def _inverse_diagonal(self) -> np.ndarray | None:
        """Diagonal of the tableau's inverse, (n_meas + n_state,); None where solves cost less or it cannot be found."""
        everywhere = np.arange(len(self._scale))
        return self._find_selected(everywhere, everywhere)

    def _diagonal(self, rows: np.ndarray) -> np.ndarray:
        """Entries ``rows`` of the diagonal of the tableau's inverse."""
        if self._inverse_diagonal is not None:
            return np.asarray(self._inverse_diagonal[rows])
        return self._solve_entries(rows, rows)

    def _solve(self, b: np.ndarray) -> np.ndarray:
        scale = self._scale.reshape(-1, *(1,) * (b.ndim - 1))
        b = self._pattern.permute(scale * b)
        scaled, change, size = self._refine(b)
        if self._pattern.fills_in and not size <= REFINED:
            self._lu = self._pattern.factor_by_superlu(self._tableau, exact=True)
            scaled, change, size = self._refine(b)
        if not self._no_rounding:
            while not size <= CONTRACTION and 0.0 < self._below.max(initial=0.0) <= LARGEST_DAMPING:  # nearly singular
                self._raise_damping()
                del self._lu
                scaled, change, size = self._refine(b)
        solution: np.ndarray = scale * self._pattern.permute_back(scaled + change)
        return solution

    def _refine(self, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """The solution for ``b``, its correction, as information is a difference, and the size of that by the other."""
        scaled = self._lu.solve(b)
        change = self._lu.solve(self._rest(b, self._tableau, scaled))
        whole = float(abs(scaled).max(initial=0.0))
        return scaled, change, float(abs(change).max(initial=0.0)) / whole if whole else 0.0

    def _rest(self, b: np.ndarray, tableau: sp.csc_array, x: np.ndarray) -> np.ndarray:
        """``b - tableau x``, shape of b."""
        if b.ndim > 1 or not self._pattern.is_compiled:
            return np.asarray(b - tableau @ x)
        from dsse_core.matrices.elimination import find_rest  # numba

        rest: np.ndarray = find_rest(tableau.indptr, tableau.indices, tableau.data, b, x)
        return rest


def reciprocal_row_lengths(H: sp.csr_array) -> np.ndarray:
    """1 / Euclidean length of each row; 1 for an empty one."""
    return reciprocal_root(np.bincount(_row_of_entries(H), H.data**2, H.shape[0]))


def scale_rows(H: sp.csr_array, scale: np.ndarray) -> sp.csr_array:
    """``diag(scale) H``."""
    return sp.csr_array((H.data * scale[_row_of_entries(H)], H.indices, H.indptr), shape=H.shape)


def _row_of_entries(H: sp.csr_array) -> np.ndarray:
    return np.repeat(np.arange(H.shape[0]), np.diff(H.indptr))


def reciprocal_root(square: np.ndarray) -> np.ndarray:
    """1 / length for each squared length; 1 where that is 0."""
    length = np.sqrt(square)
    return np.asarray(1 / np.where(length > 0, length, 1.0))


def raise_damping(below: np.ndarray) -> np.ndarray:
    """Larger scaled damping, where rounding has swallowed ``below``.

    Raises:
        RuntimeError: the damping is 0, or large enough already.
    """
    if not below.any() or below.max() > LARGEST_DAMPING:
        raise RuntimeError("the tableau is exactly singular")
    return below * 1e3
