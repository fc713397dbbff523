"""Elimination of all variables within an area by reflections, one piece of its tree after another.

In one piece the work grows with the cube of the nodes. So the tree is divided into pieces of some PIECE nodes, from its
leaves to its top. A piece takes the rows that have one of its own voltages and are in no piece below, and joins what is
left of the pieces below. It eliminates its own voltages x_o from these rows (``reflections.py``):

``Q'[A_o A_b r] = [[R_o, S, z_o], [0, A_up, z_up]]``, so that ``R_o dx_o = z_o - S dx_b``.

x_b are the voltages of pieces above and the variables of the area's boundaries, shifts included. The rows that are left
are turned into as many as x_b has variables, and go up. Between pieces there are voltages alone: with powers, and rows
that tie them, a piece would cost twice as much. What the last piece leaves are rows about the area's boundaries, as
those of one piece would be. A small area is one piece.

**Exact rows** weigh 1e9 times as much as others, so their rounding must not count as information. They go up apart from
other rows, as few as possible of them with variables of a piece (``turn_alone``). Their pivots may be far apart: beside
a heavy one, a light one of size e becomes ``e + rounding`` and is known to ``rounding / e`` only. A row with a pivot
below LIGHT of the largest goes up with the piece's variables that it still has, and a piece above, which has more of
the exact rows, eliminates them. Where all pivots are far above other rows, all rows are eliminated at once.

**Covariances** go down: with ``L_b L_b'`` that of x_b, L of the piece's variables is

``[x_o; x_b] = [[R_o^-1, -R_o^-1 S L_b], [0, L_b]] e``, e of variance 1.

Covariances in place of L would be small differences of large numbers; they became negative. In the same way the
directions in which weighted rows have no part, a root of the residuals' covariance, go down from the rows that a piece
has handed up to the rows of its meters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.columns import split_by
from dsse_core.grid.network_table import NetworkTable
from dsse_core.grid.radial_order import walk_graph
from dsse_core.linear.interface import Matrix
from dsse_core.linear.reflections import NOISE, Eliminated, eliminate, turn_alone

PIECE = 20  # nodes, or up to twice as many: with 10 or 40 a step takes a quarter longer
CLEAR = 100.0  # times the largest entry of other rows: only exact rows have such pivots
ENOUGH = 1e8  # times the root of the least information: a pivot above it needs no row of next to no weight
LIGHT = 1e-7  # of the largest pivot of exact rows: lighter than other rows, which have sigmas of some 1e-3


@dataclass(frozen=True)
class Piece:
    """A part of the variables within an area, by columns: those within, then those of the boundaries, shifts last.

    ``rows``: rows of the area, the first ``n_exact`` of them exact. ``entries``: of H, at ``at``: places in ``rows``,
    and in ``own`` and ``others``; unused where H is dense. ``above``: the piece to which rows go up.
    """

    own: np.ndarray
    others: np.ndarray
    rows: np.ndarray
    n_exact: int
    entries: np.ndarray
    at: tuple[np.ndarray, np.ndarray]
    above: int

    @cached_property
    def columns(self) -> np.ndarray:
        return np.concatenate([self.own, self.others])


class _Up(NamedTuple):
    """Rows for the piece above, ``exact`` and ``others``, with ``columns`` and residuals; ``late``: the first columns,
    which that piece eliminates. ``piece``: the number of the piece below.
    """

    piece: int
    late: np.ndarray
    columns: np.ndarray
    exact: np.ndarray
    others: np.ndarray


class _Joined(NamedTuple):
    """Rows of a piece with their ``columns`` and residuals; ``n`` columns, the first ones, are to be eliminated.

    The first ``n_exact`` rows are exact. ``first``: the first place of the piece's own rows. ``below``: pieces, and the
    first places of their rows beside exact ones.
    """

    A: np.ndarray
    columns: np.ndarray
    n: int
    n_exact: int
    first: int
    below: list[tuple[int, int]]


class _Done(NamedTuple):
    """A piece with its ``own`` variables eliminated, beside ``others``.

    ``packed``: the rows left, turned into as many as others; None where there are no more. ``kept``: the places of the
    eliminated rows, None of all, among ``n_rows``. ``first``: the first place of the area's own rows. ``below``: pieces
    below, and the first places of their rows.
    """

    own: np.ndarray
    others: np.ndarray
    eliminated: Eliminated
    packed: Eliminated | None
    kept: np.ndarray | None
    n_rows: int
    first: int
    below: list[tuple[int, int]]


class Pieces:
    """The division of an area's rows and variables into pieces, for all states.

    ``read`` (n,): positions in x of the columns but the two shifts, the first ``n_within`` of them within the area.
    ``least`` (n,): information about these columns in case that nothing else determines them. ``piece`` (n_within,):
    the piece of each column, the lowest first. ``together`` (:, size): rows in all of x without weight; the lowest
    piece with a variable of such a row has all of them. ``of_column`` (n + 2,): the piece that eliminates each column.
    """

    def __init__(
        self,
        H: Matrix,
        exact: np.ndarray,
        read: np.ndarray,
        n_within: int,
        least: np.ndarray,
        piece: np.ndarray,
        together: sp.csr_array | None = None,
    ) -> None:
        self._H, self._read, self._n_within, self._least = H, read, n_within, np.sqrt(least)
        self._size = len(read) + 2
        self.of_column = np.zeros(self._size, dtype=int)
        self._place = np.zeros(self._size, dtype=int)  # of columns in the piece at hand
        if isinstance(H, np.ndarray):
            none = np.zeros(0, dtype=int)
            own, others = np.split(np.arange(self._size), [n_within])
            rows = np.concatenate([exact, np.delete(np.arange(len(H)), exact)])
            self._pieces = [Piece(own, others, rows, len(exact), none, (none, none), 0)]
        else:
            self._pieces = self._divide(H, exact, piece, together)
        last = self._pieces[-1]
        weighed = np.append(last.own, np.arange(n_within, len(read)))
        self._enough = ENOUGH * self._least[:n_within].max(initial=0.0)
        least = self._find_least_rows(last.columns, weighed)  # of the last piece
        self._least_rows = least[:, : len(last.own)], least[:, len(last.own) : -1]

    def __len__(self) -> int:
        return len(self._pieces)

    def fits(self, H: Matrix) -> bool:
        """True where ``H`` has its entries at the same places."""
        known = self._H
        if isinstance(H, np.ndarray) or isinstance(known, np.ndarray):
            return H.shape == known.shape
        is_same = H.indices is known.indices or np.array_equal(H.indices, known.indices)
        return is_same and np.array_equal(H.indptr, known.indptr)

    def _divide(
        self, H: sp.csr_array, exact: np.ndarray, piece: np.ndarray, together: sp.csr_array | None
    ) -> list[Piece]:
        """The pieces, the lowest first; without variables within, one."""
        n, m, shifts = self._n_within, H.shape[0], np.arange(self._size - 2, self._size)
        names = np.unique(piece)
        count = max(len(names), 1)
        self.of_column[:], self.of_column[:n] = count - 1, np.searchsorted(names, piece)
        self._row = np.repeat(np.arange(m), np.diff(H.indptr))
        entries, row, column = self._locate(H)
        of_row, is_exact = self.find_lowest(m, row, column), np.isin(np.arange(m), exact)
        place = np.zeros(m, dtype=int)  # of rows in the piece at hand
        of_rows, of_entries = split_by(of_row, count), split_by(of_row[row], count)
        of_columns = split_by(self.of_column[:n], count)
        from_below: list[list[np.ndarray]] = [[] for _ in range(count)]
        from_below[-1].append(np.arange(n, self._size))
        if together is not None:
            _, beside, joined = self._locate(together)
            for k, here in enumerate(split_by(self.find_lowest(together.shape[0], beside, joined)[beside], count)):
                from_below[k].append(joined[here])
        found: list[Piece] = []
        for k, (own, rows, here) in enumerate(zip(of_columns, of_rows, of_entries, strict=True)):
            others = np.setdiff1d(np.concatenate([column[here], shifts, *from_below[k]]), own)
            self._place[own], self._place[others] = np.arange(len(own)), len(own) + np.arange(len(others))
            rows = np.concatenate([rows[is_exact[rows]], rows[~is_exact[rows]]])
            place[rows] = np.arange(len(rows))
            at = place[row[here]], self._place[column[here]]
            above = int(self.of_column[others].min())
            if k < count - 1:
                from_below[above].append(others)
            found.append(Piece(own, others, rows, int(is_exact[rows].sum()), entries[here], at, above))
        return found

    def _locate(self, H: sp.csr_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The entries of H in the columns that are read, their rows, and their columns."""
        of_x = np.full(H.shape[1], -1)
        of_x[self._read] = np.arange(len(self._read))
        entries = np.flatnonzero(of_x[H.indices] >= 0)
        return entries, np.repeat(np.arange(H.shape[0]), np.diff(H.indptr))[entries], of_x[H.indices[entries]]

    def find_lowest(self, n_row: int, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """The lowest piece that has a variable of each of ``n_row`` rows, for their entries."""
        lowest = np.full(n_row, self.of_column[-1])
        np.minimum.at(lowest, row, self.of_column[column])
        return lowest

    def eliminate(self, H: Matrix, beside: np.ndarray, sigma: np.ndarray) -> Reduction:
        """All variables within the area eliminated from its rows.

        ``H`` (m, size) in all of x. ``beside`` (m, 3): the responses to the two shifts, and residuals. Rows are divided
        by ``sigma`` (m,).
        """
        beside = beside / sigma[:, None]
        entries = H[:, self._read] / sigma[:, None] if isinstance(H, np.ndarray) else H.data / sigma[self._row]
        done: list[_Done] = []
        arrived: list[list[_Up]] = [[] for _ in self._pieces]
        for k, piece in enumerate(self._pieces[:-1]):
            found, up = self._eliminate(k, piece, self._join(piece, entries, beside, arrived[k]))
            done.append(found)
            arrived[piece.above].append(up)
        joined = self._join(self._pieces[-1], entries, beside, arrived[-1], self._least_rows)
        done.append(_eliminate_last(joined))
        return Reduction(done, self._pieces, self._n_within)

    def _join(
        self,
        piece: Piece,
        entries: np.ndarray,
        beside: np.ndarray,
        arrived: list[_Up],
        least: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> _Joined:
        """All rows of a piece: exact ones from below, its own, others from below, then ``least``; variables that come
        late stand after its own.
        """
        n, m, columns, n_late = len(piece.own), len(piece.rows), piece.columns, 0
        own, n_rows = sum(len(up.exact) for up in arrived), m + (0 if least is None else len(least[0]))
        n_rows += own + sum(len(up.others) for up in arrived)
        if late := [up.late for up in arrived if len(up.late)]:
            n_late = sum(map(len, late))
            columns = np.concatenate([piece.own, *late, piece.others])
        A = np.zeros((n_rows, len(columns) + 1), order="F")  # that of LAPACK
        of_own = A[own : own + m]
        if entries.ndim > 1:
            of_own[:, :-3] = entries[piece.rows]
        else:
            row, column = piece.at
            of_own[row, np.where(column < n, column, column + n_late) if n_late else column] = entries[piece.entries]
        of_own[:, -3:] = beside[piece.rows]
        if least is not None:
            A[n_rows - len(least[0]) :, :n], A[n_rows - len(least[0]) :, n + n_late : -1] = least
        below = []
        if arrived:
            self._place[columns] = np.arange(len(columns))
            of_exact, first = 0, own + m
            for up in arrived:
                at = np.append(self._place[up.columns], -1)
                if len(up.exact):
                    A[of_exact : of_exact + len(up.exact), at] = up.exact
                A[first : first + len(up.others), at] = up.others
                below.append((up.piece, first))
                of_exact, first = of_exact + len(up.exact), first + len(up.others)
        return _Joined(A, columns, n + n_late, own + piece.n_exact, own, below)

    def _eliminate(self, k: int, piece: Piece, joined: _Joined) -> tuple[_Done, _Up]:
        """A piece eliminated, but variables that its light exact rows take along, and the rows that go up.

        A row of next to no weight for each variable joins them only where one is not determined: these rows would
        double the work.
        """
        A, columns, n, n_exact, first, below = joined
        eliminated, over, n_rows, kept = _eliminate_at_once(joined, LIGHT), A[:0], len(A), None
        if eliminated is None:
            A[:n_exact], above = turn_alone(A[:n_exact], n, LIGHT)
            over = A[above:n_exact]
            if (is_late := over[:, :n].any(axis=0)).any():
                order = np.argsort(is_late, kind="stable")  # late ones last
                A[:, :n], columns = A[:, order], np.concatenate([columns[order], columns[n:]])
                n -= int(is_late.sum())
            if len(over):
                kept = np.delete(np.arange(n_rows), slice(above, n_exact))
                A = A[kept]
            eliminated = eliminate(A, n)
        own = columns[:n]
        if eliminated.least_pivot < self._enough:
            eliminated = eliminate(np.concatenate([A, self._find_least_rows(columns, own)]), n)
            kept = np.append(np.arange(n_rows) if kept is None else kept, n_rows + np.arange(n))
            n_rows += n
        packed, of_over = _pack(eliminated.rows), _pack(over[:, n:])
        up = _Up(
            piece=k,
            late=columns[n : len(columns) - len(piece.others)],
            columns=columns[n:],
            exact=over[:, n:] if of_over is None else of_over.heads,
            others=eliminated.rows if packed is None else packed.heads,
        )
        return _Done(own, columns[n:], eliminated, packed, kept, n_rows, first, below), up

    def _find_least_rows(self, columns: np.ndarray, of: np.ndarray) -> np.ndarray:
        """A row of next to no weight for each of the columns ``of``, among ``columns`` and residuals."""
        rows = np.zeros((len(of), len(columns) + 1))
        self._place[columns] = np.arange(len(columns))
        rows[np.arange(len(of)), self._place[of]] = self._least[of]
        return rows


@dataclass(frozen=True)
class Reduction:
    """The variables within an area, eliminated: those of one piece after another."""

    _done: list[_Done]
    _pieces: list[Piece]
    _n_within: int

    @property
    def rows(self) -> np.ndarray:
        """The rows that are left, in the variables of the boundaries, both shifts, and residuals."""
        return self._done[-1].eliminated.rows

    def with_power(self, power: np.ndarray) -> Reduction:
        """The reduction of a state without power into children, moved to ``power``, of which rows are linear functions.

        The powers are the first variables of the boundaries.
        """
        n, moved = self._n_within, []
        for done in self._done[:-1]:
            at, part = np.flatnonzero((done.others >= n) & (done.others < n + len(power))), done.eliminated
            turned = _with_power(part.turned, at, power[done.others[at] - n])
            moved.append(done._replace(eliminated=part._replace(turned=turned)))
        last, of_power = self._done[-1], slice(len(power))
        turned, rows = (_with_power(part, of_power, power) for part in (last.eliminated.turned, last.eliminated.rows))
        moved.append(last._replace(eliminated=last.eliminated._replace(turned=turned, rows=rows)))
        return Reduction(moved, self._pieces, n)

    def substitute(self, dy: np.ndarray) -> np.ndarray:
        """dx, the variables within, for ``dy``, those of the boundaries and both shifts."""
        if len(self._done) == 1:
            return self._done[0].eliminated.substitute(dy)
        dx = np.concatenate([np.zeros(self._n_within), dy])
        for done in reversed(self._done):
            dx[done.own] = done.eliminated.substitute(dx[done.others])
        return dx[: self._n_within]

    def spread(self, dy: np.ndarray) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
        """Pieces from the last one on: number k, number n of own variables, all columns, and the root F of their
        covariance, (len(columns), :). The first n columns are own ones, the last two both shifts.

        ``dy``: root of the covariance of the variables of the boundaries and both shifts.
        """
        place = np.zeros(self._n_within + len(dy), dtype=int)
        roots: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for k in reversed(range(len(self._done))):
            done, of_others = self._done[k], dy
            if roots:
                columns, root = roots[self._pieces[k].above]
                place[columns] = np.arange(len(columns))
                of_others = _narrow(root[place[done.others]])
            of_own = done.eliminated.spread(of_others)
            n, both = len(of_own), np.zeros((len(of_own) + len(of_others), of_own.shape[1]))
            both[:n], both[n:, n:] = of_own, of_others
            roots[k] = np.concatenate([done.own, done.others]), both
            yield k, n, *roots[k]

    def collect(self, B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``B F`` for functions B (k, :) of all variables without the part of the boundaries; B as functions of these.

        F: the root of the covariance of all variables.
        """
        left, parts = B.T.copy(), []
        for done in self._done:
            part = done.eliminated.reflect(left[done.own])
            parts.append(part)
            left[done.others] -= done.eliminated.turned[:, :-1].T @ part
        return np.concatenate(parts).T, left[self._n_within :].T

    def turn_back(self, left: np.ndarray) -> np.ndarray:
        """The share of each row of the area that no variable takes up, (m,): squared length of the rows of Q_0.

        ``left`` (len(rows), :): directions of the rows left in which the variables of the boundaries have no part. That
        of exact rows is not looked for.
        """
        found, known = np.zeros(sum(len(piece.rows) for piece in self._pieces)), {len(self._done) - 1: left}
        for k in reversed(range(len(self._done))):
            done, heads = self._done[k], known.pop(k)
            if (packed := done.packed) is not None:
                heads = packed.turn_back(np.eye(len(packed.rows)), heads)
            back = done.eliminated.turn_back(heads)
            if done.kept is not None:
                back, kept = np.zeros((done.n_rows, back.shape[1])), back
                back[done.kept] = kept
            rows = self._pieces[k].rows
            own = back[done.first : done.first + len(rows)]
            found[rows] = np.vecdot(own, own)
            for below, first in done.below:
                known[below] = _narrow(back[first : first + self._n_up(below)])
        return found

    def _n_up(self, k: int) -> int:
        """The number of rows that piece k hands up beside exact ones."""
        done = self._done[k]
        return len(done.eliminated.rows if done.packed is None else done.packed.turned)


def divide_tree(table: NetworkTable, root: int) -> np.ndarray:
    """The piece of each bus, by rows, (n_bus,), 0 for the lowest; each has some PIECE nodes.

    Of a piece a bus and all below it that is in no piece yet, or all below several of its branches.
    """
    order, upstream = walk_graph(table.graph, table.rows.row_of(root))
    n_nodes = np.bincount(table.nodes.item, minlength=len(table.bus_id))
    piece, n_pieces = np.full(len(table.bus_id), -1), 0
    open_buses: dict[int, list[int]] = {}  # at a bus: those of pieces still open below
    weight = np.zeros(len(table.bus_id), dtype=int)
    for bus in order[::-1].tolist():
        group = [*open_buses.pop(bus, []), bus]
        size, up = int(weight[bus] + n_nodes[bus]), int(upstream[bus])
        if size >= PIECE or up == bus:
            piece[group], n_pieces = n_pieces, n_pieces + 1
            continue
        if weight[up] and weight[up] + size > 2 * PIECE:
            piece[open_buses.pop(up)], n_pieces, weight[up] = n_pieces, n_pieces + 1, 0
        open_buses.setdefault(up, []).extend(group)
        weight[up] += size
    piece[piece < 0] = n_pieces  # out of reach of the root
    return piece


def _eliminate_last(joined: _Joined) -> _Done:
    A, columns, n, n_exact, first, below = joined
    eliminated = _eliminate_at_once(joined, NOISE)
    if eliminated is None:
        A[:n_exact], _ = turn_alone(A[:n_exact], n)
        eliminated = eliminate(A, n)
    return _Done(columns[:n], columns[n:], eliminated, None, None, len(A), first, below)


def _eliminate_at_once(joined: _Joined, least: float) -> Eliminated | None:
    """Elimination of all rows, exact ones and others; None where the exact rows must be turned alone before.

    These need no turn if each has a pivot above ``least`` of the largest, and CLEAR of all other rows.
    """
    A, _, n, n_exact, *_ = joined
    if not n_exact:
        return eliminate(A, n)
    if n_exact > n:
        return None
    sizes = np.abs(A[:, :n]).max(axis=1)
    clear = CLEAR * sizes[n_exact:].max(initial=0.0)
    if sizes[:n_exact].min() < clear:
        return None
    eliminated = eliminate(A, n)
    pivots = abs(eliminated.triangle.diagonal())
    return eliminated if pivots[n_exact - 1] > max(least * pivots[0], clear) else None


def _pack(rows: np.ndarray) -> Eliminated | None:
    """``rows`` turned into as many as variables; None where they are no more than these."""
    n = rows.shape[1] - 1
    return eliminate(rows, n) if len(rows) > n else None


def _narrow(root: np.ndarray) -> np.ndarray:
    """A root (k, at most k) of the same covariance as ``root`` (k, :)."""
    return np.asarray(np.linalg.qr(root.T, mode="r")).T if root.shape[1] > len(root) else root


def _with_power(rows: np.ndarray, at: np.ndarray | slice, power: np.ndarray) -> np.ndarray:
    """``rows`` moved to powers in the columns ``at``."""
    moved, change = rows.copy(), rows[:, at] @ power
    moved[:, -1] -= change
    moved[:, -3] += 2 * change  # the shift takes the powers along
    return moved
