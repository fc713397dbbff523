"""Entries of the inverse of a symmetric matrix whose blocks make a tree, level by level.

For a block ``i`` with the parent ``p``, ``S_i = A_ii - sum of A_ci' X_c`` over its children c and
``X_i = S_i^-1 A_ip``. On the way back ``Z_ip = -X_i Z_pp`` and ``Z_ii = S_i^-1 + X_i Z_pp X_i'``. All blocks of a level
are eliminated at once, each with row pivoting inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.admittance import follow
from dsse_core.matrices.selected_inverse import WRONG

Entries = tuple[np.ndarray, np.ndarray]
"""Numbers of entries of A, and their places among the entries of blocks; (k,) each."""


@dataclass(frozen=True, repr=False)
class BlockTree:
    """Blocks of the rows of matrices of one pattern. ``block``, ``place`` (n,): the block of each row, and the place of
    the row in it. ``parent``, ``size`` (n_block,); the root's parent is itself. ``levels``: blocks by their distance
    from the root, from 1 on, children of one parent side by side.
    """

    block: np.ndarray
    place: np.ndarray
    parent: np.ndarray
    size: np.ndarray
    levels: list[np.ndarray]

    def find_inverse(self, A: sp.csc_array, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The entries (rows[k], columns[k]) of the inverse of ``A``, and True for those that may have lost digits.

        Both have the shape (k,). Entries that join a block neither with itself nor with its parent are nan; all are nan
        where a block is singular.
        """
        n, m = len(self.size), int(self.size.max())
        own, up = np.zeros((n, m, m)), np.zeros((n, m, m))
        at_own, at_up = self._locate(A, m)
        for blocks, (e, where) in ((own, at_own), (up, at_up)):
            blocks.ravel()[where] = A.data[e]
        filled, there = np.nonzero(np.arange(m) >= self.size[:, None])
        own[filled, there, there] = 1.0
        try:
            self._invert(own, up)
        except np.linalg.LinAlgError:
            return np.full(len(rows), np.nan), np.ones(len(rows), dtype=bool)
        n_row, sums = len(self.block), np.full(len(self.block), -1.0)  # of Z A - 1, at its diagonal
        for blocks, (e, where) in ((own, at_own), (up, at_up)):
            product = blocks.ravel()[where] * A.data[e]
            sums += np.bincount(A.indices[e], product, n_row)
        sums += np.bincount(_columns_of(A)[e], product, n_row)  # the entries on the other side of the blocks' diagonal
        wrong = ~(np.maximum(abs(sums[rows]), abs(sums[columns])) <= WRONG)
        return self._take(own, up, rows, columns), wrong

    def _locate(self, A: sp.csc_array, m: int) -> tuple[Entries, Entries]:
        """The entries of A inside blocks, and those that join a block with its parent."""
        column = _columns_of(A)
        of_row, of_column = self.block[A.indices], self.block[column]
        found = []
        for e in (np.flatnonzero(of_row == of_column), np.flatnonzero(of_row < of_column)):
            found.append((e, (of_row[e] * m + self.place[A.indices[e]]) * m + self.place[column[e]]))
        return found[0], found[1]

    def _invert(self, own: np.ndarray, up: np.ndarray) -> None:
        """Puts ``Z_ii`` in place of ``A_ii`` and ``Z_ip`` in place of ``A_ip``, (n_block, m, m) each."""
        unit = np.eye(own.shape[1])
        for level in reversed(self.levels):
            A_ip = up[level]
            both = np.linalg.solve(own[level], np.concatenate([A_ip, np.broadcast_to(unit, A_ip.shape)], axis=2))
            X, own[level] = both[:, :, : len(unit)], both[:, :, len(unit) :]
            up[level] = X  # from the inverse it would lose three digits
            first = np.flatnonzero(np.diff(self.parent[level], prepend=-1))
            own[self.parent[level[first]]] -= np.add.reduceat(A_ip.transpose(0, 2, 1) @ X, first, axis=0)
        own[-1] = np.linalg.inv(own[-1])
        for level in self.levels:
            X = up[level]
            up[level] = Z_ip = -(X @ own[self.parent[level]])
            own[level] -= Z_ip @ X.transpose(0, 2, 1)

    def _take(self, own: np.ndarray, up: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Entries of Z, (k,); nan where no block has the entry."""
        swap = self.block[rows] > self.block[columns]
        rows, columns = np.where(swap, columns, rows), np.where(swap, rows, columns)
        i, p, r, c = self.block[rows], self.block[columns], self.place[rows], self.place[columns]
        found = np.where(i == p, own[i, r, c], up[i, r, c])
        return np.where((i == p) | (p == self.parent[i]), found, np.nan)


def _columns_of(A: sp.csc_array) -> np.ndarray:
    """The column of each entry, (nnz,)."""
    return np.repeat(np.arange(A.shape[0], dtype=np.int32), np.diff(A.indptr))


def find_block_tree(A: sp.csc_array, block: np.ndarray) -> BlockTree | None:
    """The tree of the blocks of A's rows; None where the blocks make no tree.

    ``block`` (n,): number of the block of each row; the numbers grow towards the root.
    """
    size = np.bincount(block)
    place, by_block = np.empty(len(block), dtype=np.int64), np.argsort(block, kind="stable")
    place[by_block] = np.arange(len(block)) - np.repeat(np.cumsum(size) - size, size)
    of_row, of_column = block[A.indices], np.repeat(block, np.diff(A.indptr))
    further = np.flatnonzero(of_row < of_column)
    child, above = of_row[further], of_column[further]
    parent = np.arange(len(size))
    parent[child] = above
    if (parent[child] != above).any() or (parent[:-1] == np.arange(len(parent) - 1)).any():
        return None
    level = follow(parent, np.minimum(np.arange(len(parent))[::-1], 1), np.add)
    order = np.lexsort((parent, level))[1:]
    levels = np.split(order, np.flatnonzero(np.diff(level[order])) + 1) if len(order) else []
    return BlockTree(block, place, parent, size, levels)
