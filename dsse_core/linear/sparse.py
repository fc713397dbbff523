"""Back end for areas of any size and shape: h(x) and H(x) in sparse matrices."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import cast

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.measurement_model import MeasurementModel
from dsse_core.grid.partition import Neighbour
from dsse_core.grid.radial_order import TableauOrder, find_tree, order_tableau
from dsse_core.linear.area_measurements import NO_ROWS, AreaMeasurements
from dsse_core.linear.boundary_information import ROUNDING
from dsse_core.linear.interface import Matrix, Received, Rows
from dsse_core.matrices.augmented import AugmentedFactor, AugmentedPattern


class Structure:
    """Rows of one pattern in some ``columns``, and the order in which their tableau is eliminated."""

    def __init__(self, area: AreaMeasurements, H: sp.csr_array, columns: np.ndarray) -> None:
        self.columns, self._indices, self._indptr = columns, H.indices, H.indptr
        place = np.full(H.shape[1], -1)
        place[columns] = np.arange(len(columns))
        self.entries = np.flatnonzero(place[H.indices] >= 0)
        indices, indptr = place[H.indices[self.entries]], np.searchsorted(self.entries, H.indptr)
        self._empty = sp.csr_array((H.data[self.entries], indices, indptr), shape=(H.shape[0], len(columns)))
        others = self._empty[len(area.model.kinds) :] if H.shape[0] > len(area.model.kinds) else None
        careful = area.flat is None
        if careful and isinstance(find_tree(area.area.network, area.area.entry_bus), str):
            self.pattern = AugmentedPattern(self._empty, careful=True)  # in the order of SuperLU
        else:
            order = order_of(area, columns, others)
            self.pattern = AugmentedPattern(
                self._empty, order.rows, fills_in=order.fills_in, careful=careful, blocks=order.blocks
            )

    def fits(self, H: sp.csr_array) -> bool:
        """True where H has this pattern."""
        if H.indices is self._indices and H.indptr is self._indptr:
            return True
        return np.array_equal(H.indptr, self._indptr) and np.array_equal(H.indices, self._indices)

    def take(self, H: sp.csr_array) -> sp.csr_array:
        """The columns of H."""
        taken = copy.copy(self._empty)  # a new one would have its indices checked each time
        taken.data = H.data.take(self.entries)
        return taken


def order_of(
    area: AreaMeasurements, columns: np.ndarray, others: sp.csr_array | None, read: MeasurementModel | None = None
) -> TableauOrder:
    """Order of the tableau of the area's meters, ``others`` and ``read`` in ``columns``; see ``order_tableau``."""
    network = area.area.network
    powers = [network.row[power.bus] for power in area.area.powers_into_children]
    return order_tableau(network, area.area.entry_bus, area.model, columns, powers=powers, others=others, read=read)


@dataclass
class Kept:
    """Parts that models of the same meters share: a structure for each set of columns; the first H, and the order of
    its entries after those of the meters and of powers; h and H at the flat start, and the factor there for the last
    sigmas, which most meters keep from scan to scan.
    """

    structures: dict[int, Structure] = field(default_factory=dict)
    first: tuple[sp.csr_array, np.ndarray] | None = None
    flat: tuple[np.ndarray, sp.csr_array] | None = None
    at_flat: dict[bytes, AugmentedFactor] = field(default_factory=dict)


class SparseRows(Rows):
    """Sparse rows of the meters and of each boundary, computed on demand."""

    def __init__(self, area: AreaMeasurements) -> None:
        self._area = area
        self._n = len(area.area.network.buses)
        self.kept = Kept()
        self._at = self._voltages_at = b""  # of the numbers that are kept: steps, messages and variances ask in turn
        self._h: np.ndarray | None = None
        self._own: np.ndarray | None = None  # h of the voltages alone
        self._H: sp.csr_array | None = None
        self._boundaries: dict[str, tuple[np.ndarray, sp.csr_array]] = {}

    def copy(self) -> SparseRows:
        """Rows that share what is kept, but no state: threads share a plan."""
        other = copy.copy(self)
        other.__dict__.update(is_compiled=self.is_compiled)
        return other

    def predict(self, x: np.ndarray) -> np.ndarray:
        """See ``Rows``; the caller must not change the array."""
        self._move_to(x)
        if self._own is None:
            model, voltages = self._area.model, x[: 2 * self._n]
            self._own = (
                model.linearize_compiled(voltages, with_H=False)[0] if self.is_compiled else model.predict(voltages)
            )
        if self._h is None:
            powers = x[2 * self._n :]
            self._h = np.asarray(self._own + self._area.into_children @ powers) if len(powers) else self._own
        return self._h

    def jacobian(self, x: np.ndarray) -> sp.csr_array:
        """See ``Rows``; the caller must not change the array. Finds h(x) in passing."""
        self._move_to(x)
        if self._H is None:
            at_flat = x is self._area.flat
            self._own, self._H = self._linearize_at_flat() if at_flat else self._linearize(x[: 2 * self._n])
        return self._H

    def _move_to(self, x: np.ndarray) -> None:
        if (at := x.tobytes()) == self._at:
            return
        if (voltages_at := x[: 2 * self._n].tobytes()) != self._voltages_at:
            self._own = self._H = None
        self._at, self._voltages_at, self._h, self._boundaries = at, voltages_at, None, {}

    def _linearize(self, voltages: np.ndarray) -> tuple[np.ndarray, sp.csr_array]:
        if self.is_compiled:
            h, data = self._area.model.linearize_compiled(voltages)
        else:
            h, data = self._area.model.linearize_entries(voltages)
        first, order = self.kept.first or self._find_first(voltages)
        H = copy.copy(first)  # a new one would have its indices checked each time
        H.data = np.concatenate([data, self._area.into_children.data])[order] if len(order) else data
        return h, H

    def _find_first(self, voltages: np.ndarray) -> tuple[sp.csr_array, np.ndarray]:
        """H of this pattern, and the order of its entries; empty where there are no powers into children."""
        H, into_children, order = self._area.model.jacobian(voltages), self._area.into_children, NO_ROWS
        if into_children.shape[1]:
            numbers = [copy.copy(H), copy.copy(into_children)]
            numbers[0].data, numbers[1].data = np.split(np.arange(H.nnz + into_children.nnz), [H.nnz])
            H = sp.csr_array(sp.hstack(numbers, format="csr"))
            order = H.data
        self.kept.first = H, order
        return self.kept.first

    def _linearize_at_flat(self) -> tuple[np.ndarray, sp.csr_array]:
        if self.kept.flat is None:
            assert self._area.flat is not None
            H, _ = self._find_first(self._area.flat)
            self.kept.flat = self._area.model.predict(self._area.flat), H
        return self.kept.flat

    @cached_property
    def is_compiled(self) -> bool:
        """True where elimination is compiled, as it may be for a whole grid."""
        area = self._area
        return area.flat is not None and self.structure(self._linearize_at_flat()[1], area.free).pattern.is_compiled

    def structure(self, H: sp.csr_array, columns: np.ndarray) -> Structure:
        """Structure of the ``columns`` of H, all rows of the area; the last one of the same columns is kept."""
        key = id(columns)  # sets of columns are kept by the area
        found = self.kept.structures.get(key)
        if found is None or found.columns is not columns or not found.fits(H):
            self.kept.structures[key] = found = Structure(self._area, H, columns)
        return found

    def boundary(self, x: np.ndarray, neighbour: Neighbour) -> tuple[np.ndarray, sp.csr_array]:
        """See ``Rows``; the caller must not change the array."""
        self._move_to(x)
        if neighbour.area not in self._boundaries:
            self._boundaries[neighbour.area] = self._find_boundary(x, neighbour)
        return self._boundaries[neighbour.area]

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
        self,
        H: Matrix,
        sigma: np.ndarray,
        damping: float | np.ndarray,
        columns: np.ndarray | None = None,
        nearby: AugmentedFactor | None = None,
    ) -> AugmentedFactor:
        """Factor of the augmented system of H, or of some ``columns`` of it, whose structure is kept.

        ``nearby``: a factor whose pivots may serve.
        """
        H = cast("sp.csr_array", H)
        if columns is None:
            return AugmentedFactor(H, sigma, damping, AugmentedPattern(H, careful=True))
        structure = self.structure(H, columns)
        return AugmentedFactor(structure.take(H), sigma, damping, structure.pattern, nearby)

    def full(self, C: Matrix) -> np.ndarray:
        return np.asarray(cast("sp.csr_array", C).toarray())
