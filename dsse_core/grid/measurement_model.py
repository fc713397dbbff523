"""h(x) and H(x): what meters would read in state x, and the derivatives, for every kind of meter.

A meter reads a quantity (``grid.quantities``) of its node's voltage ``u = C v`` and of the metered current
``i = Y v + K conj(s / v)``. Injections and flows differ only in the rows of ``Y`` (a node's or a port's). A total is
the mean of the rows of its phases. K counts powers s that leave a node into branches which the network does not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.admittance import Admittance
from dsse_core.grid.further_currents import FurtherCurrents, add_up, find_currents_of_taps
from dsse_core.grid.measurement import Meter
from dsse_core.grid.meter_table import OF_VOLTAGE, QUANTITY, average, find_first, tabulate_meters
from dsse_core.grid.network import Network
from dsse_core.grid.quantities import CURRENT_FLOOR, VOLTAGE_FLOOR, Phasors, Quantity, QuantityRows


@dataclass(frozen=True)
class MeasurementModel:
    """The measurement functions of ``meters``; ``x = [va; vm]``, shape (2 n_nodes,), rad and p.u.; then what the
    ``further`` currents depend on.

    ``kinds``: (n_meas,), places in KINDS. ``y`` (n_row, n_nodes) holds admittances, ``node`` (n_row,) the node of each
    row. ``other`` (n_row,): the node to which its voltage counts, -1 for the ground; None where that is so for all.
    ``of_meter`` (n_row,): the meter of each row, see ``MeterTable.spread``; None where each has one.
    """

    kinds: np.ndarray
    node: np.ndarray
    y: sp.csr_array
    row: np.ndarray  # (nnz,): the row of each stored entry of y
    at_node: np.ndarray  # (nnz,): C at the entry's column, 1 at the metered node and -1 at the other one
    other: np.ndarray | None = None
    of_meter: np.ndarray | None = None
    further: tuple[FurtherCurrents, ...] = ()

    def predict(self, x: np.ndarray) -> np.ndarray:
        """h(x), shape (n_meas,), p.u. and rad."""
        u, i, _, _ = self._phasors(x)
        return average(self.read(u, i), self.of_meter)

    def subtract(self, z: np.ndarray, h: np.ndarray) -> np.ndarray:
        """z - h, shape (n_meas,); differences of angles are wrapped to (-pi, pi]."""
        r = np.asarray(z - h)
        angles = self._angles
        if angles.size:
            r[angles] = np.pi - (np.pi - r[angles]) % (2 * np.pi)
        return r

    def jacobian(self, x: np.ndarray) -> sp.csr_array:
        """H(x) = dh/dx, shape (n_meas, len(x)); its pattern is the same for every x."""
        return self.linearize(x)[1]

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, sp.csr_array]:
        """h(x) and H(x) at once."""
        h, data = self.linearize_entries(x)
        _, indices, indptr = self._pattern
        return h, sp.csr_array((data, indices, indptr), shape=(len(self.kinds), len(x)))

    def linearize_entries(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """h(x) and the stored entries of H(x), whose places are the same for every x.

        Every meter's ``dh = Re(of_u du + of_i di) = Re(a dv)`` with ``a = of_u C + of_i Y``. And ``dv/dva = j v``,
        ``dv/dvm = exp(j va)``.
        """
        u, i, vm, phase = self._phasors(x)
        of_u, of_i = self.weigh(u, i)
        row, column = self.row, self.y.indices
        along = (of_u[row] * self.at_node + of_i[row] * self.y.data) * phase[column]
        parts = [-along.imag * vm[column], along.real]
        parts += [currents.find_derivatives(x, vm * phase, of_i).ravel() for currents in self.further]
        return average(self.read(u, i), self.of_meter), self._join(np.concatenate(parts))

    def _join(self, derivatives: np.ndarray) -> np.ndarray:
        """The entries of H from derivatives by va, then by vm, of all entries of y, then of further currents."""
        places = self._pattern[0]
        if self._has_one_entry_each:
            return np.asarray(derivatives[places])
        return np.bincount(places, derivatives * self.shares[self._rows_of_entries])

    @cached_property
    def _has_one_entry_each(self) -> bool:
        """True where no derivatives add up in an entry of H."""
        return self.of_meter is None and not self.further

    @cached_property
    def meters(self) -> np.ndarray:
        """The meter of each row, (n_row,)."""
        return np.arange(len(self.node)) if self.of_meter is None else self.of_meter

    @cached_property
    def shares(self) -> np.ndarray:
        """The share of each row in the reading of its meter, (n_row,)."""
        return np.ones(len(self.node)) if self.of_meter is None else 1 / np.bincount(self.of_meter)[self.of_meter]

    @cached_property
    def _rows_of_entries(self) -> np.ndarray:
        """The row of each of the derivatives that ``_join`` takes."""
        n = self.y.shape[1]
        further = (np.tile(currents.row, len(currents.list_columns(n))) for currents in self.further)
        return np.concatenate([self.row, self.row, *further])

    def linearize_compiled(self, x: np.ndarray, *, with_H: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """``linearize_entries``, or without ``with_H`` h(x) and no entries, by compiled code: needs numba.

        Compiled code has no further currents.
        """
        if self.further:
            return self.linearize_entries(x)
        from dsse_core.grid import derivatives

        places = self._pattern[0] if self._has_one_entry_each else np.arange(2 * self.y.nnz)
        y, floors = self.y, (CURRENT_FLOOR, VOLTAGE_FLOOR)
        of_rows = self._quantity, y.indptr, y.indices, y.data, self.at_node
        h, entries = derivatives.linearize(x, *of_rows, places if with_H else places[:0], floors)
        h = average(h, self.of_meter)
        return h, entries if self._has_one_entry_each or not with_H else self._join(entries)

    def read(self, u: np.ndarray, i: np.ndarray) -> np.ndarray:
        """Readings of the rows of ``u`` and ``i``, shape (n_row,) each."""
        return self._rows.read(Phasors(u, i))

    def weigh(self, u: np.ndarray, i: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``of_u`` and ``of_i`` of every row, shape (n_row,), complex; see ``linearize_entries``."""
        return self._rows.weigh(u, i)

    @cached_property
    def _pattern(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The pattern of H: the order in which its rows hold the derivatives that ``_join`` takes, or, where some add
        up, the place of each in H; the columns; the ends of rows.
        """
        n, row = self.y.shape[1], self._rows_of_entries
        further = (currents.list_columns(n).ravel() for currents in self.further)
        columns = np.concatenate([self.y.indices, self.y.indices + n, *further])
        if self._has_one_entry_each:
            order = np.argsort(row, kind="stable")
            return order, columns[order], 2 * self.y.indptr
        width = int(columns.max()) + 1
        there, places = np.unique(self.meters[row].astype(np.int64) * width + columns, return_inverse=True)
        return places, there % width, np.searchsorted(there, width * np.arange(len(self.kinds) + 1))

    def _phasors(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        n = self.y.shape[1]
        va, vm = x[:n], x[n : 2 * n]
        phase = np.exp(1j * va)
        v = vm * phase
        return self.find_voltages(v), add_up(self.y @ v, self.further, x, v), vm, phase

    @cached_property
    def first_rows(self) -> np.ndarray:
        """The first row of each meter, (n_meas,)."""
        return np.arange(len(self.kinds)) if self.of_meter is None else find_first(self.of_meter)

    def find_voltages(self, v: np.ndarray) -> np.ndarray:
        """The metered voltages u = C v, (n_row,), for those of all nodes, (n_nodes,)."""
        u: np.ndarray = v[self.node]
        return u if self.other is None else u - np.where(self.other < 0, 0.0, v[self.other])

    @cached_property
    def _rows(self) -> QuantityRows:
        return QuantityRows(self._quantity)

    @cached_property
    def _quantity(self) -> np.ndarray:
        """The quantity that each row reads, (n_row,)."""
        quantity: np.ndarray = QUANTITY.astype(np.int8)[self.kinds]
        return quantity if self.of_meter is None else quantity[self.of_meter]

    @cached_property
    def _angles(self) -> np.ndarray:
        """The meters of angles."""
        return np.flatnonzero(QUANTITY[self.kinds] == Quantity.VA)


def stack_models(above: MeasurementModel, below: MeasurementModel) -> MeasurementModel:
    """The rows of two models of one network."""
    n_above, n_row = len(above.kinds), len(above.node)
    have_one_row = above.of_meter is None and below.of_meter is None
    return MeasurementModel(
        kinds=np.concatenate([above.kinds, below.kinds]),
        node=np.concatenate([above.node, below.node]),
        y=sp.csr_array(sp.vstack([above.y, below.y], format="csr")),
        row=np.concatenate([above.row, n_row + below.row]),
        at_node=np.concatenate([above.at_node, below.at_node]),
        other=None if above.other is None or below.other is None else np.concatenate([above.other, below.other]),
        of_meter=None if have_one_row else np.concatenate([above.meters, n_above + below.meters]),
        further=above.further + tuple(currents.below(n_row) for currents in below.further),
    )


def build_measurement_model(
    network: Network, admittance: Admittance, meters: Sequence[Meter], *, first_tap: int | None = None
) -> MeasurementModel:
    """The model of ``meters``: of each its node and its row of ``stacked``, that of the node or of the port.

    ``first_tap``: the place in x of the first estimated tap; None where all taps are as the network has them.
    """
    table, of_meter = tabulate_meters(network, meters).spread()
    rows = np.where(table.branch < 0, table.node, network.n_nodes + table.port)
    model = build_model_of_rows(admittance.stacked, rows, table.kind, table.node, table.other, of_meter)
    if first_tap is None or not network.estimated_taps:
        return model
    rows = np.where(OF_VOLTAGE[table.kind], -1, rows)
    return replace(model, further=find_currents_of_taps(network, admittance, rows, first_tap))


def build_model_of_rows(
    stacked: sp.csr_array,
    rows: np.ndarray,
    kind: np.ndarray,
    node: np.ndarray,
    other: np.ndarray | None = None,
    of_meter: np.ndarray | None = None,
) -> MeasurementModel:
    """The model of rows of ``kind``, places in KINDS: of each its row of the admittances ``stacked``, and its node.

    Rows of voltages keep only the entry of their node, as 0: others would fill in the tableau.
    """
    first, of_voltage = stacked.indptr[rows], OF_VOLTAGE[kind]
    count = np.where(of_voltage, 1, stacked.indptr[rows + 1] - first)
    row, indptr = np.repeat(np.arange(len(rows)), count), np.append(0, np.cumsum(count))
    entries = (first - indptr[:-1])[row] + np.arange(len(row))
    data, columns, own = stacked.data[entries], stacked.indices[entries], indptr[:-1][of_voltage]
    data[own], columns[own] = 0.0, node[of_voltage]
    y = sp.csr_array((data, columns, indptr), shape=(len(rows), stacked.shape[1]))
    if other is not None:
        y = _with_entries(y, other)
        row = np.repeat(np.arange(len(rows)), np.diff(y.indptr))
    at_node = (y.indices == node[row]).astype(float)
    return MeasurementModel(
        kinds=kind if of_meter is None else kind[find_first(of_meter)],
        node=node,
        y=y,
        row=row,
        at_node=at_node if other is None else at_node - (y.indices == other[row]),
        other=other,
        of_meter=of_meter,
    )


def _with_entries(y: sp.csr_array, column: np.ndarray) -> sp.csr_array:
    """``y`` (k, n) with a stored entry in each row's ``column`` (k,), be it zero; -1 for none."""
    row, found = np.flatnonzero(column >= 0), y.tocoo()
    rows, columns = np.append(found.coords[0], row), np.append(found.coords[1], column[row])
    return sp.csr_array(sp.coo_array((np.append(found.data, np.zeros(len(row))), (rows, columns)), shape=y.shape))
