"""Loads and shunts as legs: a leg draws power between a node and another one, or the ground."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from dsse_core.grid.nodes import PHASE_ANGLE, PhaseRows

if TYPE_CHECKING:
    from scipy.sparse import csr_array


GROUND = -1  # in place of the row of a node


@dataclass(frozen=True, slots=True)
class Load:
    """A leg at a bus with phases: from ``phases`` "a" to the ground, of "ab" between a and b.

    It draws ``s``, complex, p.u., at its nominal voltage, at another P and Q times that share to the ``exponents``: 0
    constant power, 1 constant current, 2 constant impedance.
    """

    bus: int
    phases: str
    s: complex
    exponents: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Shunt:
    """A leg of known admittance ``y``, complex, p.u. as in ``Primitive``: a part of the grid, as its branches are."""

    bus: int
    phases: str
    y: complex


@dataclass(frozen=True)
class Legs:
    """All legs of a network, (n_leg,) each: the rows of ``node`` and of ``other``, or GROUND; see ``Load``.

    The balanced load of a bus is one leg of constant power. ``nominal``: the nominal voltages of all nodes, (n_nodes,).
    """

    node: np.ndarray
    other: np.ndarray
    s: np.ndarray
    exponents: np.ndarray  # (n_leg, 2), of P and of Q
    nominal: np.ndarray

    @cached_property
    def at_nominal(self) -> np.ndarray:
        """The power drawn at each node at the nominal voltages, complex, p.u., (n_nodes,)."""
        return self.draw(self.nominal)

    @cached_property
    def varying(self) -> Legs | None:
        """The legs whose powers at nodes depend on voltages, all but those of constant power to ground; None without
        any.
        """
        varies = (self.other >= 0) | self.exponents.any(axis=1)
        if not varies.any():
            return None
        return Legs(self.node[varies], self.other[varies], self.s[varies], self.exponents[varies], self.nominal)

    def find_excess(self, v: np.ndarray) -> np.ndarray:
        """The power drawn at each node at voltages ``v`` above that at nominal ones, complex, p.u., (n_nodes,)."""
        varying = self.varying
        excess: np.ndarray = varying.draw(v) - varying.at_nominal if varying else np.zeros(len(v), dtype=complex)
        return excess

    def draw(self, v: np.ndarray) -> np.ndarray:
        """The power drawn at each node, complex, p.u., at voltages ``v``, complex, (n_nodes,) each."""
        u = self._between(v)
        p, q = self._draw_by_leg(u)
        i = ((p + 1j * q) / u).conj()
        current, between = np.zeros(len(v), dtype=complex), self.other >= 0
        np.add.at(current, self.node, i)
        np.add.at(current, self.other[between], -i[between])
        drawn: np.ndarray = v * current.conj()
        return drawn

    def differentiate(self, v: np.ndarray) -> csr_array:
        """The derivatives of ``draw`` by x = [va; vm], complex, (n_nodes, 2 n_nodes).

        With ``c = s / u`` a leg draws ``v c`` at its node and ``-v c`` at the other one; ``dc = (ds - c du) / u`` and
        ``ds = (P of_p exponent_p + j Q ...) Re(conj(u) du) / |u|^2``. And ``dv = j v dva + v / |v| dvm``.
        """
        from scipy.sparse import csr_array  # as in ``NetworkTable.graph``

        n, u = len(v), self._between(v)
        p, q = self._draw_by_leg(u)
        c, slope = (p + 1j * q) / u, p * self.exponents[:, 0] + 1j * (q * self.exponents[:, 1])
        rows, columns, entries = [], [], []
        ends = ((self.node, 1.0), (self.other, -1.0))
        for by, sign in ends:
            for part, dv in enumerate((1j * v[by], v[by] / abs(v[by]))):
                du = sign * dv
                dc = (slope * (u.conj() * du).real / abs(u) ** 2 - c * du) / u
                for at, direction in ends:
                    rows.append(np.where((at < 0) | (by < 0), -1, at))
                    columns.append(part * n + by)
                    entries.append(direction * (v[at] * dc + (dv * c if at is by else 0.0)))
        row, column, entry = map(np.concatenate, (rows, columns, entries))
        there = row >= 0
        return csr_array((entry[there], (row[there], column[there])), shape=(n, 2 * n))

    def _draw_by_leg(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """P and Q of each leg at the voltage ``u`` across it."""
        of_p, of_q = (abs(u) / abs(self._between(self.nominal)))[:, None].T ** self.exponents.T
        return self.s.real * of_p, self.s.imag * of_q

    def _between(self, v: np.ndarray) -> np.ndarray:
        return np.asarray(v[self.node] - np.where(self.other < 0, 0.0, v[self.other]))


def find_nominal(nodes: PhaseRows) -> np.ndarray:
    """Voltages of 1 p.u., phases a third of a turn apart, complex, (n_nodes,)."""
    return np.asarray(np.exp(1j * PHASE_ANGLE[nodes.phase]))
