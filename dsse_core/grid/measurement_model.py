"""h(x) and H(x): what meters would read in state x, and the derivatives, for every kind of meter.

With the metered node's voltage ``u = C v`` and the metered current ``i = Y v`` one formula serves all kinds:
``s = u conj(i)`` (P, Q of injections and of both branch ends), ``|i|``, ``|u|`` and ``arg u``. Injections
and flows differ only in the rows of ``Y`` (a node's or a port's).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dsse_core.grid.admittance import Admittance
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.grid.meter_table import KINDS, tabulate_meters
from dsse_core.grid.network import Network

CURRENT_FLOOR = 1e-9  # p.u.; below it the derivative of |i| is undefined and taken as 0
VOLTAGE_FLOOR = 1e-9  # p.u.; least divisor |u| of the derivatives of |u| and arg u


@dataclass(frozen=True)
class MeasurementModel:
    """The measurement functions of ``meters``; ``x = [va; vm]``, shape (2 n_nodes,), rad and p.u.

    ``y`` (n_meas, n_nodes) holds the admittance row of each meter, ``node`` (n_meas,) its node. ``other``
    (n_meas,): the node to which its voltage counts, -1 for the ground; None where that is so for all.
    """

    kinds: np.ndarray
    node: np.ndarray
    y: sp.csr_array
    meter_row: np.ndarray  # (nnz,): the meter of each stored entry of y
    at_node: np.ndarray  # (nnz,): C at the entry's column, 1 at the metered node and -1 at the other one
    other: np.ndarray | None = None

    def predict(self, x: np.ndarray) -> np.ndarray:
        """h(x), shape (n_meas,), p.u. and rad."""
        u, i, _, _ = self._phasors(x)
        return self.read(u, i)

    def subtract(self, z: np.ndarray, h: np.ndarray) -> np.ndarray:
        """z - h, shape (n_meas,); differences of angles are wrapped to (-pi, pi]."""
        r = np.asarray(z - h)
        angles = self._rows[-1]
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
        row, column = self.meter_row, self.y.indices
        along = (of_u[row] * self.at_node + of_i[row] * self.y.data) * phase[column]
        return self.read(u, i), np.concatenate([-along.imag * vm[column], along.real])[self._pattern[0]]

    def linearize_compiled(self, x: np.ndarray, *, with_H: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """``linearize_entries``, or without ``with_H`` h(x) and no entries, by compiled code: needs numba."""
        from dsse_core.grid import derivatives

        places = self._pattern[0] if with_H else self._pattern[0][:0]
        y, floors = self.y, (CURRENT_FLOOR, VOLTAGE_FLOOR)
        of_meters = self._reads, y.indptr, y.indices, y.data, self.at_node
        found: tuple[np.ndarray, np.ndarray] = derivatives.linearize(x, *of_meters, places, floors)
        return found

    @cached_property
    def _reads(self) -> np.ndarray:
        """The quantity that each meter reads, (n_meas,), by the numbers of ``derivatives``."""
        reads = self._is_reactive.astype(np.int8)
        for k, rows in enumerate(self._rows):
            reads[rows] = 2 + k
        return reads

    def read(self, u: np.ndarray, i: np.ndarray) -> np.ndarray:
        """h of ``u`` and ``i``, shape (n_meas,) each."""
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
        """``of_u`` and ``of_i`` of every meter, shape (n_meas,), complex; see ``linearize``."""
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
        of y; the columns; the ends of rows.
        """
        order = np.argsort(np.concatenate([self.meter_row, self.meter_row]), kind="stable")
        indices = np.concatenate([self.y.indices, self.y.indices + self.y.shape[1]])[order]
        return order, indices, 2 * self.y.indptr

    def _phasors(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        n = self.y.shape[1]
        va, vm = x[:n], x[n:]
        phase = np.exp(1j * va)
        v = vm * phase
        return self.find_voltages(v), self.y @ v, vm, phase

    def find_voltages(self, v: np.ndarray) -> np.ndarray:
        """The metered voltages u = C v, (n_meas,), for those of all nodes, (n_nodes,)."""
        u: np.ndarray = v[self.node]
        return u if self.other is None else u - np.where(self.other < 0, 0.0, v[self.other])

    @cached_property
    def _rows(self) -> list[np.ndarray]:
        """The rows of the meters that read no power: of |i|, of |u| and of arg u."""
        return [np.flatnonzero(self.kinds == kind) for kind in _NO_POWER]

    @cached_property
    def _is_reactive(self) -> np.ndarray:
        return np.isin(self.kinds, (MeasurementKind.Q_INJECTION, MeasurementKind.Q_FLOW))

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
    return MeasurementModel(
        kinds=np.concatenate([above.kinds, below.kinds]),
        node=np.concatenate([above.node, below.node]),
        y=sp.csr_array(sp.vstack([above.y, below.y], format="csr")),
        meter_row=np.concatenate([above.meter_row, len(above.kinds) + below.meter_row]),
        at_node=np.concatenate([above.at_node, below.at_node]),
        other=None if above.other is None or below.other is None else np.concatenate([above.other, below.other]),
    )


def build_measurement_model(network: Network, admittance: Admittance, meters: Sequence[Meter]) -> MeasurementModel:
    """The model of ``meters``: of each its node and its row of ``stacked``, that of the node or of the port."""
    table = tabulate_meters(network, meters)
    rows = np.where(table.branch < 0, table.node, network.n_nodes + table.port)
    return build_model_of_rows(sp.csr_array(admittance.stacked[rows]), table.kind, table.node, table.other)


def build_model_of_rows(
    y: sp.csr_array, kind: np.ndarray, node: np.ndarray, other: np.ndarray | None = None
) -> MeasurementModel:
    """The model of meters of ``kind``, places in KINDS, with their rows ``y`` of admittances and their nodes."""
    if other is not None:
        y = _with_entries(y, other)
    meter_row = np.repeat(np.arange(len(kind)), np.diff(y.indptr))
    at_node = (y.indices == node[meter_row]).astype(float)
    return MeasurementModel(
        kinds=np.array(KINDS, dtype="<U12")[kind],
        node=node,
        y=y,
        meter_row=meter_row,
        at_node=at_node if other is None else at_node - (y.indices == other[meter_row]),
        other=other,
    )


def _with_entries(y: sp.csr_array, column: np.ndarray) -> sp.csr_array:
    """``y`` (k, n) with a stored entry in each row's ``column`` (k,), be it zero; -1 for none."""
    row, found = np.flatnonzero(column >= 0), y.tocoo()
    rows, columns = np.append(found.coords[0], row), np.append(found.coords[1], column[row])
    return sp.csr_array(sp.coo_array((np.append(found.data, np.zeros(len(row))), (rows, columns)), shape=y.shape))
