"""Loads as legs: a leg draws power between a node and another one, or the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dsse_core.grid.nodes import PHASE_ANGLE, PhaseRows


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


@dataclass(frozen=True)
class Legs:
    """All legs of a network, (n_leg,) each: the rows of ``node`` and of ``other``, -1 for the ground; see ``Load``.

    The balanced load of a bus is one leg of constant power.
    """

    node: np.ndarray
    other: np.ndarray
    s: np.ndarray
    exponents: np.ndarray  # (n_leg, 2), of P and of Q

    def draw(self, v: np.ndarray, nominal: np.ndarray) -> np.ndarray:
        """The power drawn at each node, complex, p.u., at voltages ``v`` and with ``nominal`` ones, (n_nodes,) each."""
        u, size = self._between(v), abs(self._between(nominal))
        of_p, of_q = (abs(u) / size)[:, None].T ** self.exponents.T
        i = ((self.s.real * of_p + 1j * (self.s.imag * of_q)) / u).conj()
        current, between = np.zeros(len(v), dtype=complex), self.other >= 0
        np.add.at(current, self.node, i)
        np.add.at(current, self.other[between], -i[between])
        drawn: np.ndarray = v * current.conj()
        return drawn

    def _between(self, v: np.ndarray) -> np.ndarray:
        return np.asarray(v[self.node] - np.where(self.other < 0, 0.0, v[self.other]))


def find_nominal(nodes: PhaseRows) -> np.ndarray:
    """Voltages of 1 p.u., phases a third of a turn apart, complex, (n_nodes,)."""
    return np.asarray(np.exp(1j * PHASE_ANGLE[nodes.phase]))
