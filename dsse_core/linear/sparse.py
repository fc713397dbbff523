"""Back end for areas of any size and shape: h(x) and H(x) in sparse matrices."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Self

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.measurement_model import MeasurementModel
from dsse_core.grid.partition import Neighbour
from dsse_core.grid.radial_order import TableauOrder, find_tree, order_tableau
from dsse_core.linear.area_measurements import NO_ROWS, AreaMeasurements
from dsse_core.linear.interface import Matrix, Received, Rows
from dsse_core.matrices.augmented import AugmentedFactor, AugmentedPattern


def order_of(
    area: AreaMeasurements, columns: np.ndarray, others: sp.csr_array | None, read: MeasurementModel | None = None
) -> TableauOrder:
    """Order of the tableau of the area's meters, ``others`` and ``read`` in ``columns``; see ``order_tableau``."""
    network = area.area.network
    powers = [network.node(power.bus, power.phase) for power in area.area.powers_into_children]
    return order_tableau(network, area.area.entry_bus, area.model, columns, powers=powers, others=others, read=read)


@dataclass
class Kept:
    """Parts that models of the same meters share: the pattern of the tableau for each set of columns; the first H, and
    the order of its entries after those of the meters and of powers.
    """

    patterns: dict[int, AugmentedPattern] = field(default_factory=dict)
    first: tuple[sp.csr_array, np.ndarray] | None = None


class SparseRows(Rows):
    """Sparse rows of the meters and of each boundary, computed on demand."""

    def __init__(self, area: AreaMeasurements) -> None:
        self._area = area
        self._n = area.n_nodes
        self._n_read = area.size if area.model.further else 2 * area.n_nodes  # of x, by the model
        self._kept = Kept()
        self._at = self._read_at = b""  # of the numbers that are kept: steps, messages and variances ask in turn
        self._h: np.ndarray | None = None
        self._own: np.ndarray | None = None  # h of the model alone
        self._H: sp.csr_array | None = None
        self._boundaries: dict[str, tuple[np.ndarray, sp.csr_array]] = {}

    def copy(self) -> Self:
        """Rows that share what is kept, but no state: threads share a plan."""
        return copy.copy(self)

    def predict(self, x: np.ndarray) -> np.ndarray:
        """See ``Rows``; the caller must not change the array."""
        self._move_to(x)
        if self._own is None:
            self._own = self._predict(x[: self._n_read])
        if self._h is None:
            powers = x[2 * self._n :]
            self._h = np.asarray(self._own + self._area.into_children @ powers) if len(powers) else self._own
        return self._h

    def _predict(self, read: np.ndarray) -> np.ndarray:
        return self._area.model.predict(read)

    def jacobian(self, x: np.ndarray) -> sp.csr_array:
        """See ``Rows``; the caller must not change the array. Finds h(x) in passing."""
        self._move_to(x)
        if self._H is None:
            self._own, self._H = self._linearize(x)
        return self._H

    def _move_to(self, x: np.ndarray) -> None:
        if (at := x.tobytes()) == self._at:
            return
        if (read_at := x[: self._n_read].tobytes()) != self._read_at:
            self._own = self._H = None
        self._at, self._read_at, self._h, self._boundaries = at, read_at, None, {}

    def _linearize(self, x: np.ndarray) -> tuple[np.ndarray, sp.csr_array]:
        """h of the model alone, and H."""
        read = x[: self._n_read]
        h, data = self._find_entries(read)
        first, order = self._kept.first or self._find_first(read)
        H = copy.copy(first)  # a new one would have its indices checked each time
        H.data = np.concatenate([data, self._area.into_children.data])[order] if len(order) else data
        return h, H

    def _find_first(self, read: np.ndarray) -> tuple[sp.csr_array, np.ndarray]:
        """H of this pattern, and the order of its entries; empty where there are no powers into children."""
        H, into_children, order = self._area.model.jacobian(read), self._area.into_children, NO_ROWS
        if n_power := into_children.shape[1]:
            parts = [H.tocoo(), sp.coo_array(into_children)]  # of no entries in common
            row, column = (np.concatenate([part.coords[k] for part in parts]) for k in (0, 1))
            column[H.nnz :] += 2 * self._n
            shape = H.shape[0], 2 * self._n + n_power
            H = sp.coo_array((np.arange(len(row)), (row, column)), shape=shape).tocsr()
            order = H.data
        self._kept.first = H, order
        return self._kept.first

    def _find_entries(self, read: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._area.model.linearize_entries(read)

    def pattern(self, H: sp.csr_array, columns: np.ndarray) -> AugmentedPattern:
        """Pattern of the tableau for the ``columns`` of H, all rows of the area; the last one of them is kept."""
        key = id(columns)  # sets of columns are kept by the area
        found = self._kept.patterns.get(key)
        if found is None or found.columns is not columns or not found.fits(H):
            n_own = len(self._area.model.kinds)
            others = H[n_own:, columns] if H.shape[0] > n_own else None
            self._kept.patterns[key] = found = self._find_pattern(H, columns, others)
        return found

    def _find_pattern(self, H: sp.csr_array, columns: np.ndarray, others: sp.csr_array | None) -> AugmentedPattern:
        """Pattern with the order of elimination of a tree, or that of SuperLU; pivots are the largest."""
        if isinstance(find_tree(self._area.area.network, self._area.area.entry_bus), str):
            return AugmentedPattern(H, columns, careful=True)
        order = order_of(self._area, columns, others)
        return AugmentedPattern(H, columns, order=order.rows, careful=True, blocks=order.blocks)

    def boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, sp.csr_array]:
        """See ``Rows``; the caller must not change the array."""
        self._move_to(x)
        if neighbour.area not in self._boundaries:
            self._boundaries[neighbour.area] = self._find_boundary(x, neighbour)
        return self._boundaries[neighbour.area]

    def _find_boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, sp.csr_array]:
        columns, (own, rows) = self._area.boundary_columns(neighbour), self._area.own_powers[neighbour.area]
        if not len(own):
            return x[columns], self._select(columns)
        into_area = self._area.into_area
        assert into_area is not None  # it has the own powers
        flows, C = into_area.linearize(x)
        C = sp.csr_array((C.data, C.indices, C.indptr), shape=(len(flows), self._area.size))
        T = sp.csr_array(sp.vstack([C[rows], self._select(columns)], format="csr"))
        y = np.concatenate([flows[rows], x[columns]])
        if own[-1] == len(own) - 1:
            return y, T
        order = self._order_of(own, len(y))
        return y[order], sp.csr_array(T[order])

    @staticmethod
    def _order_of(own: np.ndarray, d: int) -> np.ndarray:
        """The places of y in own powers followed by the other variables."""
        return np.argsort(np.concatenate([own, np.setdiff1d(np.arange(d), own)]))

    def boundary_values(self, x: np.ndarray, neighbour: Neighbour) -> np.ndarray:
        columns, (own, rows) = self._area.boundary_columns(neighbour), self._area.own_powers[neighbour.area]
        if not len(own):
            return np.asarray(x[columns])
        y = np.empty(len(own) + len(columns))
        y[np.setdiff1d(np.arange(len(y)), own)] = x[columns]
        assert self._area.into_area is not None  # it has the own powers
        if self._area.into_area.further:
            y[own] = self._area.into_area.predict(x)[rows]
            return y
        powers: list[float] = []
        for bus, there, admittance, mutual in self._branches_into_area[rows.start // 2 : rows.stop // 2]:
            va, vm = x[there], x[self._n + there]
            v = float(x[self._n + bus])
            s = (admittance * v * v).sum() + (mutual * (v * vm * np.exp(1j * (x[bus] - va)))).sum()
            powers += [s.real, s.imag]
        y[own] = powers
        return y

    @cached_property
    def _branches_into_area(self) -> list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
        """For each node of the powers into the area: its row, rows of the branches' other ends, conj of own admittance
        and of mutual ones.
        """
        assert self._area.into_area is not None
        found = []
        for k, bus in enumerate(self._area.into_area.node[::2].tolist()):
            y = self._area.into_area.y[[2 * k], :].tocoo()
            columns, values = y.coords[1], y.data.conj()
            at_bus = columns == bus
            found.append((bus, columns[~at_bus], values[at_bus], values[~at_bus]))
        return found

    def _select(self, columns: Sequence[int]) -> sp.csr_array:
        shape = (len(columns), self._area.size)
        return sp.csr_array((np.ones(len(columns)), np.array(columns), np.arange(len(columns) + 1)), shape=shape)

    def messages(self, x: np.ndarray, received: Received) -> tuple[list[Matrix], list[np.ndarray]]:
        """See ``Rows``; one matrix for all messages, as an area may have many children."""
        rows: list[tuple[np.ndarray, np.ndarray]] = []  # numbers, and the columns that they belong to
        r: list[np.ndarray] = []
        for n in self._area.area.neighbours:
            if (message := received.get(n.area)) is None:
                continue
            R, z = message.rows
            if len(self._area.own_powers[n.area][0]):
                y, T = self.boundary(x, n)
                rows.append((np.asarray(R @ T), np.arange(self._area.size)))
            else:
                columns = np.array(self._area.boundary_columns(n))
                y = x[columns]
                rows.append((R, columns))
            r.append(z - R @ y)
        if not rows:
            return [], []
        given = [part != 0 for part, _ in rows]
        data = np.concatenate([part[is_given] for (part, _), is_given in zip(rows, given, strict=True)])
        at = np.concatenate([np.broadcast_to(columns, k.shape)[k] for (_, columns), k in zip(rows, given, strict=True)])
        ends = np.cumsum(np.concatenate([[0], *(is_given.sum(axis=1) for is_given in given)]))
        of_all = sp.csr_array((data, at, ends), shape=(len(ends) - 1, self._area.size))
        return [of_all], r

    def take(self, H: sp.csr_array) -> sp.csr_array:
        return H

    def join(self, parts: list[Matrix]) -> sp.csr_array:
        return sp.csr_array(sp.vstack(parts, format="csr"))

    def factor(
        self,
        H: sp.csr_array,
        sigma: np.ndarray,
        damping: np.ndarray,
        columns: np.ndarray,
        nearby: AugmentedFactor | None = None,
    ) -> AugmentedFactor:
        """Factor of the augmented system of some ``columns`` of H; ``nearby``: a factor whose pivots may serve."""
        return AugmentedFactor(H, sigma, damping, self.pattern(H, columns), nearby)
