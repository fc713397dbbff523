"""Back end for areas of any size and shape: h(x) and H(x) in sparse matrices."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import cast

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.partition import Neighbour
from dsse_core.grid.radial_order import TableauPlaces, find_tree, place_in_tree
from dsse_core.linear.area_measurements import AreaMeasurements
from dsse_core.linear.boundary_information import ROUNDING
from dsse_core.linear.interface import Matrix, Received, Rows
from dsse_core.matrices.augmented import AugmentedFactor, AugmentedPattern


class SparseRows(Rows):
    """Sparse rows of the meters and of each boundary, computed on demand."""

    def __init__(self, area: AreaMeasurements) -> None:
        self._area = area
        self._n = len(area.area.network.buses)
        self._at = b""  # the x of the numbers that are kept: steps, messages and variances ask for them in turn
        self._h: np.ndarray | None = None
        self._H: sp.csr_array | None = None
        self._boundaries: dict[str, tuple[np.ndarray, sp.csr_array]] = {}

    def predict(self, x: np.ndarray) -> np.ndarray:
        """See ``Rows``; the caller must not change the array."""
        self._move_to(x)
        if self._h is None:
            own = self._area.model.predict(x[: 2 * self._n])
            self._h = np.asarray(own + self._area.into_children @ x[2 * self._n :])
        return self._h

    def jacobian(self, x: np.ndarray) -> sp.csr_array:
        """See ``Rows``; the caller must not change the array."""
        self._move_to(x)
        if self._H is None:
            own = self._area.model.jacobian(x[: 2 * self._n])
            self._H = sp.csr_array(sp.hstack([own, self._area.into_children], format="csr"))
        return self._H

    def boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, sp.csr_array]:
        """See ``Rows``; the caller must not change the array."""
        self._move_to(x)
        if neighbour.area not in self._boundaries:
            self._boundaries[neighbour.area] = self._find_boundary(x, neighbour)
        return self._boundaries[neighbour.area]

    def _move_to(self, x: np.ndarray) -> None:
        if (at := x.tobytes()) != self._at:
            self._at, self._h, self._H, self._boundaries = at, None, None, {}

    def _find_boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, sp.csr_array]:
        columns = self._area.boundary_columns(neighbour)
        if not neighbour.is_parent:
            return x[columns], self._select(columns)
        into_area = self._area.into_area
        assert into_area is not None  # there is a parent
        flows = into_area.predict(x[: 2 * self._n])
        C = sp.csr_array(into_area.jacobian(x[: 2 * self._n]))
        C = sp.csr_array((C.data, C.indices, C.indptr), shape=(len(flows), self._area.size))
        T = sp.vstack([C, self._select(columns)], format="csr")
        return np.concatenate([flows, x[columns]]), sp.csr_array(T)

    def boundary_values(self, x: np.ndarray, neighbour: Neighbour) -> np.ndarray:
        if not neighbour.is_parent:
            return np.asarray(x[self._area.boundary_columns(neighbour)])
        powers: list[float] = []
        for bus, there, own, mutual in self._branches_at_parent:
            va, vm = x[there], x[self._n + there]
            v = float(x[self._n + bus])
            s = (own * v * v).sum() + (mutual * (v * vm * np.exp(1j * (x[bus] - va)))).sum()
            powers += [s.real, s.imag]
        return np.concatenate([powers, x[self._area.voltage_columns(neighbour)]])

    @cached_property
    def _branches_at_parent(self) -> list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
        """For each bus of the parent's boundary: its row, rows of the branches' other ends, conj of own admittance and
        of mutual ones.
        """
        assert self._area.into_area is not None
        found = []
        for k, bus in enumerate(self._area.into_area.bus_row[::2].tolist()):
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
            if n.is_parent:
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

    def without_rounding(self, H: Matrix) -> sp.csr_array:
        """H with entries of 0 where a derivative is only rounding."""
        H = cast("sp.csr_array", H)
        row = np.repeat(np.arange(H.shape[0]), np.diff(H.indptr))
        size = abs(H.data)
        largest = np.zeros(H.shape[0])
        np.maximum.at(largest, row, size)
        return sp.csr_array((np.where(size > ROUNDING * largest[row], H.data, 0.0), H.indices, H.indptr), shape=H.shape)

    def factor(
        self, H: Matrix, sigma: np.ndarray, damping: np.ndarray, columns: np.ndarray | None = None
    ) -> AugmentedFactor:
        """Factor of the augmented system of ``H``.

        Where ``columns`` are given and the area is a tree, elimination goes from the buses far from the parent to the
        parent's bus, which takes a third of the time.
        """
        H, order = sp.csr_array(H), None
        if columns is not None and self._places is not None:
            of_columns = self._place_columns[columns]
            of_rows = np.concatenate([self._places.of_meter, self._place_others(H, of_columns)])
            order = np.argsort(np.concatenate([of_rows, of_columns]), kind="stable")
        return AugmentedFactor(H, sigma, damping, AugmentedPattern(H, order, careful=True))

    @cached_property
    def _places(self) -> TableauPlaces | None:
        """Places of buses and meters in the order of elimination; None where the area has loops."""
        network, entry = self._area.area.network, self._area.area.entry_bus
        tree = find_tree(network, entry)
        return None if isinstance(tree, str) else place_in_tree(tree, self._area.model)

    @cached_property
    def _place_columns(self) -> np.ndarray:
        """Place of each variable, shape (size,); the power into a child has that of the voltages of its bus."""
        assert self._places is not None
        area, of_bus = self._area.area, self._places.of_bus
        of_powers = [area.network.row[power.bus] for power in area.powers_into_children]
        return np.concatenate([of_bus, of_bus, of_bus[np.array(of_powers, dtype=int)]])

    def _place_others(self, H: sp.csr_array, of_columns: np.ndarray) -> np.ndarray:
        """Place of each row after the meters', of further rows and messages: just before the last of its variables."""
        first = H.indptr[len(self._area.meters) :]
        found, is_given = np.zeros(len(first) - 1, dtype=np.int64), np.diff(first) > 0
        if is_given.any():
            last = np.maximum.reduceat(of_columns[H.indices[first[0] :]], first[:-1][is_given] - first[0])
            found[is_given] = last - 1
        return found

    def full(self, C: Matrix) -> np.ndarray:
        return np.asarray(cast("sp.csr_array", C).toarray())
