"""Currents that count in rows of a measurement model beside ``Y v``: what is beyond the network, what a tap changes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from dsse_core.grid.admittance import Admittance
from dsse_core.grid.network import Network


@dataclass(frozen=True)
class FurtherCurrents(ABC):
    """Currents by x = [va; vm; further variables] that add to those of some rows, (k,) each; ``row`` (k,)."""

    row: np.ndarray

    def below(self, n_row: int) -> Self:
        """The same in rows that stand below ``n_row`` others."""
        return replace(self, row=n_row + self.row)

    @abstractmethod
    def find(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The currents at x, of voltages ``v`` (n_nodes,)."""

    @abstractmethod
    def find_derivatives(self, x: np.ndarray, v: np.ndarray, of_i: np.ndarray) -> np.ndarray:
        """The derivatives of the rows by some variables each, (n_variable, k), where ``dh = Re(of_i di)``, ``of_i``
        (n_row,).
        """

    @abstractmethod
    def list_columns(self, n: int) -> np.ndarray:
        """The columns of these derivatives, (n_variable, k), in a network of n nodes."""


@dataclass(frozen=True)
class CurrentsBeyond(FurtherCurrents):
    """Currents ``conj(s / v)`` into branches that the network does not have: the node, and the place in x of P, before
    Q, (k,) each.
    """

    node: np.ndarray
    power: np.ndarray

    def find(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.asarray((self._find_powers(x) / v[self.node]).conj())

    def find_derivatives(self, x: np.ndarray, v: np.ndarray, of_i: np.ndarray) -> np.ndarray:
        """Derivatives by va, vm, P and Q: ``Re(of_i di) = Re(a (ds - s / v dv))`` with ``a = conj(of_i) / v``."""
        at, n = v[self.node], len(v)
        a, s = of_i[self.row].conj() / at, self._find_powers(x)
        return np.array([(a * s).imag, -(a * s).real / x[n + self.node], a.real, -a.imag])

    def list_columns(self, n: int) -> np.ndarray:
        return np.array([self.node, n + self.node, self.power, self.power + 1])

    def _find_powers(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(x[self.power] + 1j * x[self.power + 1])


@dataclass(frozen=True)
class CurrentsOfTaps(FurtherCurrents):
    """Currents ``y ((tap / t)^degree - 1) v`` of a tap t where Y has ``tap``, (k,) each.

    ``y``: the entry of Y at the row and the ``node``, of the tap's branch alone. ``degree``: 2 between the from side
    and itself, 1 between both sides. ``place``: of t in x.
    """

    node: np.ndarray
    y: np.ndarray
    degree: np.ndarray
    tap: np.ndarray
    place: np.ndarray

    def find(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.asarray(self.y * (self._find_share(x) - 1) * v[self.node])

    def find_derivatives(self, x: np.ndarray, v: np.ndarray, of_i: np.ndarray) -> np.ndarray:
        """Derivatives by va, vm and t."""
        at, share, n = v[self.node], self._find_share(x), len(v)
        along = of_i[self.row] * self.y * at
        by_v = along * (share - 1)
        return np.array([-by_v.imag, by_v.real / x[n + self.node], -(along * share * self.degree).real / x[self.place]])

    def list_columns(self, n: int) -> np.ndarray:
        return np.array([self.node, n + self.node, self.place])

    def _find_share(self, x: np.ndarray) -> np.ndarray:
        return np.asarray((self.tap / x[self.place]) ** self.degree)


def find_currents_of_taps(
    network: Network, admittance: Admittance, rows: np.ndarray, first: int
) -> tuple[CurrentsOfTaps, ...]:
    """The currents by estimated taps in ``rows`` (n_row,) of ``admittance.stacked``, -1 for none.

    ``first``: the place in x of the first tap. Empty where no tap counts.
    """
    table, n, n_active = network.table, network.n_nodes, len(network.table.active)
    found = []
    for k, (branch, at) in enumerate(network.estimated_taps.items()):
        f, t, own = int(table.f[at]), int(table.t[at]), (n + at, n + n_active + at)
        yff, yft, ytf = (complex(admittance.stacked[place]) for place in ((own[0], f), (own[0], t), (own[1], f)))
        for places, node, y, degree in (((f, own[0]), f, yff, 2), ((f, own[0]), t, yft, 1), ((t, own[1]), f, ytf, 1)):
            tap = network.branch(branch).tap
            found += [(row, node, y, degree, tap, first + k) for row in np.flatnonzero(np.isin(rows, places)).tolist()]
    return (CurrentsOfTaps(*map(np.array, zip(*found, strict=True))),) if found else ()


def add_up(of_rows: np.ndarray, further: Sequence[FurtherCurrents], x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """``of_rows`` (n_row,), currents Y v, with ``further`` ones added in place, at x of voltages ``v``."""
    for currents in further:
        np.add.at(of_rows, currents.row, currents.find(x, v))
    return of_rows
