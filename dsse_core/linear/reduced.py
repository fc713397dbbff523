"""Numerics of a small area by one orthogonal factor for each state: the area reduced to its boundaries.

Reflections eliminate the variables within the area from all weighted rows; the boundaries' variables y are left:

``Q'[W H | W r] = [[R_w, R_wy, z_w], [0, R_y, z_y]]`` with R_w upper triangular.

The information for a neighbour, and the step at the boundaries, follow from the rows ``R_y``, ``z_y`` and from the
messages of other neighbours; the voltages within the area follow by substitution. The reduction needs no message, so it
is done while one is awaited.

Powers into the area from buses of others are functions of the voltages next to these, which are not eliminated either.
The last two variables are shifts of the whole area (``shift_of_own_rows``). They replace the voltage of one boundary
bus, and so protect the information about that voltage, and the steps over short branches, from rounding. Rows with
weights over many decades keep their digits each, as heavy rows come first and columns are pivoted (Higham, Accuracy and
Stability of Numerical Algorithms, 20.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self, cast

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.boundary import Boundary, Kind
from dsse_core.grid.columns import split_by
from dsse_core.grid.partition import Area, Neighbour
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.boundary_information import EXACT_SIGMA, TIED_SIGMA, BoundaryInformation
from dsse_core.linear.interface import Matrix, Received, Rows
from dsse_core.linear.pieces import Pieces, Reduction, divide_tree
from dsse_core.linear.reflections import Eliminated, eliminate, triangulate, turn_alone
from dsse_core.linear.rows import RowSolver, shift_of_own_rows
from dsse_core.linear.sparse import SparseRows
from dsse_core.matrices.augmented import BLOCK

REFLECTED_NOT_YET = 1e-10  # NOT_YET by reflections, which keep the digits of the least that voltmeters tell, 1e2


@dataclass(frozen=True)
class _Reduced:
    """The area at a state ``x``.

    ``boundaries``: neighbour -> y, shape (d,), and ``[dy | -y]`` by the variables of the boundaries.
    """

    x: np.ndarray
    within: Reduction
    boundaries: dict[str, tuple[np.ndarray, np.ndarray]]


class ReducedSolver(RowSolver):
    """Solver for steps, information and variances by two stages of reflections; steps with damping take one.

    Dense rows are eliminated in one piece, sparse ones in pieces along the area's tree. ``together`` (:, size): rows of
    variables that stand together in one piece, beside those of the meters.
    """

    not_yet = REFLECTED_NOT_YET

    def __init__(self, model: AreaMeasurements, rows: Rows, name: str, together: sp.csr_array | None = None) -> None:
        super().__init__(model, rows, name)
        self._together = together
        self._order = _Order(model)
        self._within: tuple[np.ndarray, Reduction] | None = None
        self._reduced: _Reduced | None = None
        self._pieces: Pieces | None = None

    def with_readings(self, model: AreaMeasurements) -> Self:
        other = super().with_readings(model)
        other._within = other._reduced = None
        return other

    def prepare(self, x: np.ndarray) -> None:
        self._reduce_voltages(x)

    def step(self, x: np.ndarray, received: Received, damping: float = 0.0) -> np.ndarray:
        if damping:
            return self._step_with_damping(x, received, damping)
        reduced, order = self._reduce(x), self._order
        rows = self._stack(reduced, received, with_shifts=True)[:, order.of_step]
        db = np.zeros(order.n_boundary)
        db[order.of_step[:-1]] = eliminate(rows, len(order.of_step) - 1).substitute(np.zeros(0))
        dx, n = np.zeros(self.model.size), order.n_within
        dx[order.read[:n]] = reduced.within.substitute(db)
        dx[order.read[n:]] = db[: len(order.read) - n]
        of_growth, of_turn = order.find_shifts(x)
        dx += of_growth * db[-2] + of_turn * db[-1]
        return dx

    def _step_with_damping(self, x: np.ndarray, received: Received, damping: float) -> np.ndarray:
        (H, r, sigma), free, dx = self.stack(x, received), self.model.free, np.zeros(self.model.size)
        m, n, least = len(r), len(free), np.maximum(self.least_information(free), damping)
        if isinstance(self.rows, SparseRows):
            dx[free] = self.rows.factor(cast("sp.csr_array", H), sigma, least, free).solve(r, np.zeros(n))[1]
            return dx
        rows = np.zeros((m + n, n + 1))
        rows[:m, :n], rows[:m, n] = H[:, free] / sigma[:, None], r / sigma
        rows[m + np.arange(n), np.arange(n)] = np.sqrt(least)
        dx[free] = eliminate(rows, n).substitute(np.zeros(0))
        return dx

    def variances(self, x: np.ndarray, received: Received) -> tuple[np.ndarray, np.ndarray]:
        """See ``LinearArea``; sums of squares lose no digit, however far sigmas and impedances are apart.

        With Q_0 the directions in which the weighted rows have no part, ``Omega = R^(1/2) Q_0 Q_0' R^(1/2)``; with F
        for which ``dx = F e``, e of variance 1, ``G^-1 = F F'``.
        """
        within, order, (of_y, last) = self._reduce(x).within, self._order, self._spread(x, received)
        shifts, found = self._find_shifts(x), np.zeros(self.model.size)
        F = shifts @ of_y[-2:]
        F[order.read[order.n_within :]] += of_y[: len(order.read) - order.n_within]
        found += np.vecdot(F, F)
        for _, n, columns, root in within.spread(of_y):
            at = order.read[columns[:n]]
            F = root[:n] + shifts[at] @ root[-2:]
            found[at] = np.vecdot(F, F)
        left = last.turn_back(np.eye(len(last.taken) - len(last.order), order="F"))[: len(within.rows)]
        R = 1 / self.model.contribution(self.rows.predict(x)).weight
        return found, self.model.real_part(R * within.turn_back(left)[: len(R)])

    def covariance(self, x: np.ndarray, received: Received, B: np.ndarray) -> np.ndarray:
        F = self._collect(x, np.hstack([B[:, self._order.read], B @ self._find_shifts(x)]), received)
        return np.asarray(F @ F.T)

    def variance_of(self, x: np.ndarray, B: sp.csr_array) -> np.ndarray:
        """diag(B G^-1 B'), (k,), for functions ``B`` (k, size) of x, without messages."""
        B, found = self._by_columns(x, B), np.zeros(B.shape[0])
        for first in range(0, len(found), BLOCK):
            F = self._collect(x, B[first : first + BLOCK].toarray(), {})
            found[first : first + BLOCK] = np.vecdot(F, F)
        return found

    def covariance_of_pairs(self, x: np.ndarray, B: sp.csr_array, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Entries (a[k], b[k]) of B G^-1 B', (k,), without messages.

        ``B`` (:, size): functions of x. Those of a pair are of variables that stand together in one piece.
        """
        self._reduce_voltages(x)
        assert self._pieces is not None  # found by the reduction
        B, found = self._by_columns(x, B), np.zeros(len(a))
        of_row = self._pieces.find_lowest(B.shape[0], np.repeat(np.arange(B.shape[0]), np.diff(B.indptr)), B.indices)
        pairs = split_by(np.minimum(of_row[a], of_row[b]), len(self._pieces))
        for k, _, columns, root in self._reduce(x).within.spread(self._spread(x, {})[0]):
            here = pairs[k]
            rows, at = np.unique(np.concatenate([a[here], b[here]]), return_inverse=True)
            F = B[rows][:, columns] @ root
            one, other = np.split(at, 2)
            found[here] = np.vecdot(F[one], F[other])
        return found

    def _by_columns(self, x: np.ndarray, B: sp.csr_array) -> sp.csr_array:
        """Functions ``B`` (k, size) of x as functions of the columns of pieces, both shifts last."""
        return sp.csr_array(sp.hstack([B[:, self._order.read], sp.csr_array(B @ self._find_shifts(x))]))

    def _find_shifts(self, x: np.ndarray) -> np.ndarray:
        return np.column_stack(self._order.find_shifts(x))

    def _collect(self, x: np.ndarray, B: np.ndarray, received: Received) -> np.ndarray:
        """``B F`` for functions B of the columns of pieces, F the root of their covariance."""
        of_within, of_rest = self._reduce(x).within.collect(B)
        return np.hstack([of_within, of_rest @ self._spread(x, received)[0]])

    def _spread(self, x: np.ndarray, received: Received) -> tuple[np.ndarray, Eliminated]:
        """The root of the covariance of the boundaries' variables and both shifts, and the second stage."""
        order = self._order
        k = len(order.of_step) - 1
        last = eliminate(self._stack(self._reduce(x), received, with_shifts=True)[:, order.of_step], k)
        of_y = np.zeros((order.n_boundary, k))
        of_y[order.of_step[:-1]] = last.spread(of_y[:0, :0])
        return of_y, last

    def information(self, x: np.ndarray, neighbour: Neighbour, received: Received) -> BoundaryInformation:
        reduced, (columns, places) = self._reduce(x), self._order.towards[neighbour.area]
        (y, dy), boundary = reduced.boundaries[neighbour.area], self.model.boundary_of(neighbour)
        rows = self._stack(reduced, {name: sent for name, sent in received.items() if name != neighbour.area})
        own, _ = self.model.own_powers[neighbour.area]
        rows = _with_powers(rows, dy[own], self.tied_sigma(boundary)) if len(own) else rows
        rows, k = rows[:, columns], len(places)
        if len(own) and not boundary.is_single:  # p and q of one node are independent
            _turn_ties(rows[-len(own) :], len(columns) - 1 - k)
        rows = triangulate(eliminate(rows, len(columns) - 1 - k).rows)
        R, z = np.zeros((boundary.d, boundary.d)), np.zeros(boundary.d)
        R[:k, places], z[:k] = rows[:k, :-1], rows[:k, -1]
        R = _undo_shifts(R, places, y, boundary)
        return BoundaryInformation(R, R @ y + z)

    def tied_sigma(self, boundary: Boundary) -> float:
        """Sigma of rows that tie powers to voltages.

        Where areas meet at several buses, rows heavier than exact ones would leave the exact information to rounding.
        """
        return TIED_SIGMA if boundary.is_single else EXACT_SIGMA

    def _stack(self, reduced: _Reduced, received: Received, *, with_shifts: bool = False) -> np.ndarray:
        """Rows of the boundaries and of messages; ``with_shifts``: and rows of next to no weight for the two shifts."""
        parts = [reduced.within.rows]
        for name, (_, dy) in reduced.boundaries.items():
            if (message := received.get(name)) is not None:
                R, z = message.rows
                part = R @ dy
                part[:, -1] += z
                parts.append(part)
        if with_shifts:
            parts.append(self._order.least_of_shifts)
        return np.concatenate(parts) if len(parts) > 1 else parts[0]

    def _reduce(self, x: np.ndarray) -> _Reduced:
        """The area reduced at ``x``, found once for a state.

        The reduction is found for the voltages, which no message changes, then moved to the powers into children. The
        rows are linear in these if no weight depends on a residual; else the reduction is found at ``x`` itself.
        """
        if self._reduced is None or not np.array_equal(self._reduced.x, x):
            within = self._reduce_voltages(x)
            power = x[2 * self.model.n_nodes :]
            if len(power) and self.model.moves_with_powers:
                within = within.with_power(power)
            boundaries = {neighbour.area: self._boundary(x, neighbour) for neighbour in self.model.area.neighbours}
            self._reduced = _Reduced(x.copy(), within, boundaries)
        return self._reduced

    def _reduce_voltages(self, x: np.ndarray) -> Reduction:
        """Elimination of the voltages within the area; without power into children where that changes no weights."""
        if self.model.moves_with_powers:
            x = np.where(np.arange(len(x)) < 2 * self.model.n_nodes, x, 0.0)
        if self._within is None or not np.array_equal(self._within[0], x):
            H, r, sigma = self.stack(x, {})
            beside = np.empty((len(r), 3))
            beside[:, :2], beside[:, 2] = shift_of_own_rows(self.model, self.rows, x, H), r
            self._within = x, self._find_pieces(H).eliminate(H, beside, sigma)
        return self._within[1]

    def _find_pieces(self, H: Matrix) -> Pieces:
        """The pieces of all rows ``H`` of the area, found once for the places of their entries."""
        if self._pieces is None or not self._pieces.fits(H):
            area, order, n = self.model.area, self._order, self.model.n_nodes
            piece = divide_tree(area.network.table, area.entry_bus)[area.network.table.nodes.item]
            least = self.least_information(order.read)
            within = order.read[: order.n_within]
            self._pieces = Pieces(
                H, self.model.exact, order.read, order.n_within, least, piece[within % n], self._together
            )
        return self._pieces

    def _boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, np.ndarray]:
        """y, shape (d,), and ``[dy | -y]`` by the variables of the boundaries."""
        order, n, boundary = self._order, self._order.n_within, self.model.boundary_of(neighbour)
        dy = order.picks[neighbour.area].copy()
        own, _ = self.model.own_powers[neighbour.area]
        if len(own):
            y, T = self.rows.boundary(x, neighbour)
            C = T[own]
            C = C if isinstance(C, np.ndarray) else C.toarray()
            dy[own, : len(order.read) - n] = C[:, order.read[n:]]
            dy[own, -2] = -C[:, self.model.fixed].sum(axis=1)
        else:
            y = self.rows.boundary_values(x, neighbour)
        dy[:, -3], dy[:, -1] = y * boundary.degrees, -y
        return y, dy


class _Order:
    """The order of an area's variables: those within it; those of its boundaries, ``n_boundary``: powers of children,
    voltages, and two shifts, which alone stand for the voltage of a single boundary bus.

    ``read``: positions in x of the variables, the first ``n_within`` of them within. ``of_step``: columns of the
    boundaries' variables without those that follow from others, then the column of residuals. ``towards``: neighbour
    -> two arrays. The first has these columns with the variables of the neighbour's y last, where shifts stand for its
    last voltage; with powers into the area they are columns of ``_with_powers``. The second has the positions in y of
    these variables.
    """

    def __init__(self, model: AreaMeasurements) -> None:
        area, n_nodes, nodes_at = model.area, model.n_nodes, model.area.network.nodes_at
        of_node = [(n_nodes + node, node) for node in range(n_nodes)]
        shared = {n.area: model.voltage_columns(n)[1::2] for n in area.neighbours}  # nodes of each boundary
        nodes = tuple(dict.fromkeys(node for n in shared.values() for node in n)) or (int(nodes_at(area.entry_bus)[0]),)
        free, kept = set(model.free.tolist()), nodes if len(nodes) > 1 else ()
        next_to_others = {end for bus in area.not_owned for end in _find_next_to(area, bus)}
        at_boundaries = list(range(2 * n_nodes, model.size))
        beside = [node for bus in sorted(next_to_others) for node in nodes_at(bus).tolist() if node not in nodes]
        at_boundaries += [k for node in (*kept, *beside) for k in of_node[node] if k in free]
        apart = {*at_boundaries, *(k for node in nodes for k in of_node[node])}
        within = [k for k in model.free.tolist() if k not in apart]
        self.n_within, self.n_boundary = len(within), len(at_boundaries) + 2
        self.read = np.array([*within, *at_boundaries], dtype=int)
        self.size = self.n_within + self.n_boundary
        self._are_powers = model.are_powers
        self._is_turned = np.isin(np.arange(n_nodes), model.free)
        place = {k: at for at, k in enumerate(at_boundaries)}
        growth, turn, residual = range(self.n_boundary - 2, self.n_boundary + 1)

        def without(node: int) -> list[int]:
            """All columns but the voltage of ``node``, for which shifts stand, and but the turn at the reference."""
            out = {place.get(k) for k in of_node[node]} | (set() if node in free else {turn})
            return [k for k in range(self.n_boundary) if k not in out]

        self.of_step = np.array([*without(nodes[0]), residual])
        self.least_of_shifts = np.zeros((2, self.n_boundary + 1))
        self.least_of_shifts[[0, 1], [growth, turn]] = REFLECTED_NOT_YET**0.5
        self.picks: dict[str, np.ndarray] = {}
        self.towards: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for n in area.neighbours:
            boundary, (own, _) = area.boundaries[n.area], model.own_powers[n.area]
            others, columns = np.setdiff1d(np.arange(boundary.d), own).tolist(), model.boundary_columns(n)
            of_y = {k: place[column] for k, column in zip(others, columns, strict=True) if column in place}
            self.picks[n.area] = pick = np.zeros((boundary.d, self.n_boundary + 1))
            pick[list(of_y), list(of_y.values())] = 1.0
            pick[boundary.places[Kind.VA], turn] = [node in free for node in shared[n.area]]
            last = shared[n.area][-1]
            of_y = {k: at for k, at in of_y.items() if at in without(last)}
            of_y |= {k: at for k, at in ((boundary.d - 2, growth), (boundary.d - 1, turn)) if at in without(last)}
            first = len(own)  # columns of ``_with_powers``
            left = [first + k for k in without(last) if k not in of_y.values()]
            found = {k: column for column, k in enumerate(own.tolist())} | {k: first + at for k, at in of_y.items()}
            places = sorted(found)
            of_neighbour = [found[k] for k in places]
            self.towards[n.area] = np.array([*left, *of_neighbour, first + residual]), np.array(places)

    def find_shifts(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The changes of x, (size,) each, where all voltages grow by a share, and where they turn by an angle, rad."""
        n = len(self._is_turned)
        of_growth = np.concatenate([np.zeros(n), x[n : 2 * n], 2 * self._are_powers[2 * n :] * x[2 * n :]])
        return of_growth, np.concatenate([self._is_turned, np.zeros(len(x) - n)])


def _find_next_to(area: Area, bus: int) -> set[int]:
    """The buses at the other ends of the branches of ``bus``."""
    ends = ((branch.from_bus, branch.to_bus) for branch in area.network.active_branches)
    return {end for pair in ends if bus in pair for end in pair} - {bus}


def _with_powers(rows: np.ndarray, dy: np.ndarray, sigma: float) -> np.ndarray:
    """``rows`` with changes of n powers into the area before other variables, without the shift's effect on these.

    ``dy``: the rows of these powers.
    """
    tie, n = dy.copy(), len(dy)
    tie[:, -3] = tie[:, -1] = 0.0
    wide = np.zeros((len(rows) + n, rows.shape[1] + n))
    wide[:-n, n:], wide[-n:, :n], wide[-n:, n:] = rows, -np.eye(n) / sigma, tie / sigma
    return wide


def _turn_ties(ties: np.ndarray, n: int) -> None:
    """Turns the rows ``ties``, in place, where they do not determine those of the first ``n`` variables that they have.

    Behind a delta winding currents sum to zero, whatever the voltages within are. The row of the sum is exact; if it
    eliminated a variable by what rounding leaves of it there, it would spread, and with it rounding, to all other rows.
    """
    turned, above = turn_alone(ties, n)
    if above < min(len(ties), int(ties[:, :n].any(axis=0).sum())):
        ties[:] = turned


def _undo_shifts(R: np.ndarray, places: np.ndarray, y: np.ndarray, boundary: Boundary) -> np.ndarray:
    """R, shape (d, d), by changes of y, from R by changes of y beside growth and turn.

    Growth and turn stand for the last voltage of y. ``places``: the positions in y of variables that are not given.
    """
    R, (vm, va) = R.copy(), (boundary.d - 2, boundary.d - 1)
    R[:, vm] = (R[:, vm] - R[:, :vm] @ (boundary.degrees * y)[:vm]) / y[vm]
    if places[-1] == va and not boundary.is_single:
        R[:, va] -= R[:, boundary.places[Kind.VA][:-1]].sum(axis=1)
    return R
