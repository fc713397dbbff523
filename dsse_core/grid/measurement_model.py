"""h(x) and H(x): what meters would read in state x, and the derivatives, for every kind of meter.

With the metered node's voltage ``u = C v`` and the metered current ``i = Y v`` one formula serves all kinds:
``s = u conj(i)`` (P, Q of injections and of both branch ends), ``|i|``, ``|u|`` and ``arg u``. Injections
and flows differ only in the rows of ``Y`` (a node's or a port's). A total is the mean of the rows of its phases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.admittance import Admittance
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.meter_table import KINDS, average, find_first, tabulate_meters
from dsse_core.grid.network import Network

CURRENT_FLOOR = 1e-9  # p.u.; below it the derivative of |i| is undefined and taken as 0
VOLTAGE_FLOOR = 1e-9  # p.u.; least divisor |u| of the derivatives of |u| and arg u


@dataclass(frozen=True)
class MeasurementModel:
    """The measurement functions of ``meters``; ``x = [va; vm]``, shape (2 n_nodes,), rad and p.u.

    ``kinds``: (n_meas,). ``y`` (n_row, n_nodes) holds admittances, ``node`` (n_row,) the node of each row. ``other``
    (n_row,): the node to which its voltage counts, -1 for the ground; None where that is so for all. ``of_meter``
    (n_row,): the meter of each row, see ``MeterTable.spread``; None where each has one.
    """

    kinds: np.ndarray
    node: np.ndarray
    y: sp.csr_array
    row: np.ndarray  # (nnz,): the row of each stored entry of y
    at_node: np.ndarray  # (nnz,): C at the entry's column, 1 at the metered node and -1 at the other one
    other: np.ndarray | None = None
    of_meter: np.ndarray | None = None

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
        """H(x) = dh/dx, shape (n_meas, 2 n_nodes); its pattern is the same for every x."""
        return self.linearize(x)[1]

    def linearize(self, x: np.ndarray) -> tuple[np.ndarray, sp.csr_array]:
        """h(x) and H(x) at once."""
        h, data = self.linearize_entries(x)
        _, indices, indptr = self._pattern
        return h, sp.csr_array((data, indices, indptr), shape=(len(self.kinds), 2 * self.y.shape[1]))

    def linearize_entries(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """h(x) and the stored entries of H(x), whose places are the same for every x.

        Every meter's ``dh = Re(a dv)`` with ``a = of_u C + of_i Y``: ``ds = conj(i) du + u conj(di)`` and
        ``Re(u conj(di)) = Re(conj(u) di)``, ``d|i| = Re(conj(i) di) / |i|``, ``d|u| = Re(conj(u) du) / |u|``,
        ``d arg u = Im(conj(u) du) / |u|^2``; ``Im s = Re(-j s)``. And ``dv/dva = j v``, ``dv/dvm = exp(j va)``.
        """
        u, i, vm, phase = self._phasors(x)
        of_u, of_i = self.weigh(u, i)
        row, column = self.row, self.y.indices
        along = (of_u[row] * self.at_node + of_i[row] * self.y.data) * phase[column]
        found = np.concatenate([-along.imag * vm[column], along.real])
        return average(self.read(u, i), self.of_meter), self._join(found)

    def _join(self, derivatives: np.ndarray) -> np.ndarray:
        """The entries of H from derivatives by va, then by vm, of all stored entries of y."""
        places = self._pattern[0]
        if self.of_meter is None:
            return np.asarray(derivatives[places])
        share = 1 / np.bincount(self.of_meter)[self.of_meter[self.row]]
        return np.bincount(places, derivatives * np.tile(share, 2))

    def linearize_compiled(self, x: np.ndarray, *, with_H: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """``linearize_entries``, or without ``with_H`` h(x) and no entries, by compiled code: needs numba."""
        from dsse_core.grid import derivatives

        places = self._pattern[0] if self.of_meter is None else np.arange(2 * self.y.nnz)
        y, floors = self.y, (CURRENT_FLOOR, VOLTAGE_FLOOR)
        of_rows = self._reads, y.indptr, y.indices, y.data, self.at_node
        h, entries = derivatives.linearize(x, *of_rows, places if with_H else places[:0], floors)
        if self.of_meter is None:
            return h, entries
        return average(h, self.of_meter), self._join(entries) if with_H else entries

    @cached_property
    def _reads(self) -> np.ndarray:
        """The quantity that each row reads, (n_row,), by the numbers of ``derivatives``."""
        reads = self._is_reactive.astype(np.int8)
        for k, rows in enumerate(self._rows):
            reads[rows] = 2 + k
        return reads

    def read(self, u: np.ndarray, i: np.ndarray) -> np.ndarray:
        """Readings of the rows of ``u`` and ``i``, shape (n_row,) each."""
        current, magnitude, angle = self._rows
        s = u * i.conj()
        h: np.ndarray = np.where(self._is_reactive, s.imag, s.real)
        if current.size:
            h[current] = abs(i[current])
        if magnitude.size:
            h[magnitude] = abs(u[magnitude])
        if angle.size:
            h[angle] = np.angle(u[angle])
        return h

    def weigh(self, u: np.ndarray, i: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``of_u`` and ``of_i`` of every row, shape (n_row,), complex; see ``linearize_entries``."""
        current, magnitude, angle = self._rows
        of_u, of_i = i.conj() * self._turn, u.conj() * self._turn_back
        if current.size:
            size = abs(i[current])
            of_i[current] = np.where(size > CURRENT_FLOOR, of_u[current] / np.maximum(size, CURRENT_FLOOR), 0.0)
            of_u[current] = 0.0
        with np.errstate(invalid="ignore"):  # nan voltages have nan derivatives, with which an iteration ends
            for rows in (magnitude, angle):
                if rows.size:
                    of_u[rows] = u[rows].conj() / np.maximum(abs(u[rows]), VOLTAGE_FLOOR)
                    of_i[rows] = 0.0
            if angle.size:
                of_u[angle] *= -1j / np.maximum(abs(u[angle]), VOLTAGE_FLOOR)
        return of_u, of_i

    @cached_property
    def _pattern(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The pattern of H: the order in which its rows hold the derivatives by va, then by vm, of all stored entries
        of y, with totals the place of each in H; the columns; the ends of rows.
        """
        columns = np.concatenate([self.y.indices, self.y.indices + self.y.shape[1]])
        if self.of_meter is not None:
            meter, n_meas, width = np.tile(self.of_meter[self.row], 2), len(self.kinds), 2 * self.y.shape[1]
            there, places = np.unique(meter.astype(np.int64) * width + columns, return_inverse=True)
            return places, there % width, np.searchsorted(there, width * np.arange(n_meas + 1))
        order = np.argsort(np.concatenate([self.row, self.row]), kind="stable")
        return order, columns[order], 2 * self.y.indptr

    def _phasors(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        n = self.y.shape[1]
        va, vm = x[:n], x[n:]
        phase = np.exp(1j * va)
        v = vm * phase
        return self.find_voltages(v), self.y @ v, vm, phase

    @cached_property
    def first_rows(self) -> np.ndarray:
        """The first row of each meter, (n_meas,)."""
        return np.arange(len(self.kinds)) if self.of_meter is None else find_first(self.of_meter)

    def find_voltages(self, v: np.ndarray) -> np.ndarray:
        """The metered voltages u = C v, (n_row,), for those of all nodes, (n_nodes,)."""
        u: np.ndarray = v[self.node]
        return u if self.other is None else u - np.where(self.other < 0, 0.0, v[self.other])

    @cached_property
    def _rows(self) -> list[np.ndarray]:
        """The rows of the meters that read no power: of |i|, of |u| and of arg u."""
        return [np.flatnonzero(self._kinds_of_rows == kind) for kind in _NO_POWER]

    @cached_property
    def _angles(self) -> np.ndarray:
        """The meters of angles."""
        return np.flatnonzero(self.kinds == MeasurementKind.VA)

    @cached_property
    def _kinds_of_rows(self) -> np.ndarray:
        return self.kinds if self.of_meter is None else self.kinds[self.of_meter]

    @cached_property
    def _is_reactive(self) -> np.ndarray:
        return np.isin(self._kinds_of_rows, (MeasurementKind.Q_INJECTION, MeasurementKind.Q_FLOW))

    @cached_property
    def _turn(self) -> np.ndarray:
        """``Im s = Re(-j s)``: -j in the rows of Q, else 1."""
        return np.where(self._is_reactive, -1j, 1.0)

    @cached_property
    def _turn_back(self) -> np.ndarray:
        return self._turn.conj()


_NO_POWER = (MeasurementKind.CURRENT, MeasurementKind.VM, MeasurementKind.VA)


def stack_models(above: MeasurementModel, below: MeasurementModel) -> MeasurementModel:
    """The rows of two models of one network."""
    n_above, n_row, both = len(above.kinds), len(above.node), (above, below)
    meters = [np.arange(len(of.node)) if of.of_meter is None else of.of_meter for of in both]
    have_one_row = above.of_meter is None and below.of_meter is None
    return MeasurementModel(
        kinds=np.concatenate([above.kinds, below.kinds]),
        node=np.concatenate([above.node, below.node]),
        y=sp.csr_array(sp.vstack([above.y, below.y], format="csr")),
        row=np.concatenate([above.row, n_row + below.row]),
        at_node=np.concatenate([above.at_node, below.at_node]),
        other=None if above.other is None or below.other is None else np.concatenate([above.other, below.other]),
        of_meter=None if have_one_row else np.concatenate([meters[0], n_above + meters[1]]),
    )


def build_measurement_model(network: Network, admittance: Admittance, meters: Sequence[Meter]) -> MeasurementModel:
    """The model of ``meters``: of each its node and its row of ``stacked``, that of the node or of the port."""
    table, of_meter = tabulate_meters(network, meters).spread()
    rows = np.where(table.branch < 0, table.node, network.n_nodes + table.port)
    return build_model_of_rows(sp.csr_array(admittance.stacked[rows]), table.kind, table.node, table.other, of_meter)


def build_model_of_rows(
    y: sp.csr_array,
    kind: np.ndarray,
    node: np.ndarray,
    other: np.ndarray | None = None,
    of_meter: np.ndarray | None = None,
) -> MeasurementModel:
    """The model of rows of ``kind``, places in KINDS, with their rows ``y`` of admittances and their nodes."""
    if other is not None:
        y = _with_entries(y, other)
    row = np.repeat(np.arange(len(kind)), np.diff(y.indptr))
    at_node = (y.indices == node[row]).astype(float)
    kinds = np.array(KINDS, dtype="<U12")[kind]
    return MeasurementModel(
        kinds=kinds if of_meter is None else kinds[find_first(of_meter)],
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
