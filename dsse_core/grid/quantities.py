"""Quantities that meters read of the metered voltage ``u = C v`` and the metered current ``i = Y v``: h, dh and units.

A kind of meter is a quantity at a place (``MeasurementKind``); the place gives the rows of C and Y. Everything else
about a kind follows from the two.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from functools import cached_property
from typing import Self, TypeAlias

import numpy as np

CURRENT_FLOOR = 1e-9  # p.u.; below it the derivative of |i| is undefined and taken as 0
VOLTAGE_FLOOR = 1e-9  # p.u.; least divisor |u| of the derivatives of |u| and arg u


class Quantity(IntEnum):
    """Re s, Im s, |i|, |u|, arg u, Re i and Im i, where ``s = u conj(i)``. ``grid.derivatives`` knows the numbers.

    A new one needs h and dh here (``_READ``, ``_WEIGH``) and compiled (``derivatives.read``), and its units and limits
    in ``scenarios/files/readings/units.py``.
    """

    degree: int
    """The power k for which readings grow as c^k when all voltages grow by c."""
    words: str
    unit: str
    """The unit in tables of results."""
    instrument: str

    P = 0, 2, "P", "kw", "active power meter"
    Q = 1, 2, "Q", "kvar", "reactive power meter"
    CURRENT = 2, 1, "current magnitude", "a", "ammeter"
    VM = 3, 1, "voltage magnitude", "pu", "voltmeter"
    VA = 4, 0, "voltage angle", "deg", "angle meter"
    I_REAL = 5, 1, "real part of the current", "a", "phasor meter"
    I_IMAG = 6, 1, "imaginary part of the current", "a", "phasor meter"

    def __new__(cls, number: int, degree: int, words: str, unit: str, instrument: str) -> Self:
        member = int.__new__(cls, number)
        member._value_ = number
        member.degree, member.words, member.unit, member.instrument = degree, words, unit, instrument
        return member

    @property
    def is_power(self) -> bool:
        return self.degree == 2

    @property
    def is_magnitude(self) -> bool:
        return self in (Quantity.CURRENT, Quantity.VM)

    @property
    def is_of_voltage(self) -> bool:
        return self in (Quantity.VM, Quantity.VA)

    @property
    def is_of_phasor(self) -> bool:
        """True for parts of the current, which a turn of all angles changes to ``j i``."""
        return self in (Quantity.I_REAL, Quantity.I_IMAG)

    @property
    def turns(self) -> bool:
        """True where a turn of all angles changes the reading."""
        return self.is_of_phasor or self is Quantity.VA

    @property
    def adds_up(self) -> bool:
        """True where the readings of phases add up to a total."""
        return self.is_power or self.is_of_phasor


class Phasors:
    """Metered voltages ``u`` and currents ``i`` of rows, (n_row,), complex, p.u., and their powers ``s``."""

    s: np.ndarray

    def __init__(self, u: np.ndarray, i: np.ndarray) -> None:
        self._u, self._i, self.s = u, i, u * i.conj()

    def currents(self, rows: np.ndarray) -> np.ndarray:
        """i of ``rows``."""
        i: np.ndarray = self._i[rows]
        return i

    def magnitudes(self, rows: np.ndarray) -> np.ndarray:
        """|u| of ``rows``."""
        size: np.ndarray = abs(self._u[rows])
        return size

    def angles(self, rows: np.ndarray) -> np.ndarray:
        """arg u of ``rows``."""
        angle: np.ndarray = np.angle(self._u[rows])
        return angle


_Read: TypeAlias = Callable[[Phasors, np.ndarray], np.ndarray]
"""Readings h of some rows, by their numbers."""
_Weigh: TypeAlias = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray | complex, np.ndarray | complex]]
"""``of_u`` and ``of_i`` of rows with voltages u and currents i, in ``dh = Re(of_u du + of_i di)``."""


def _weigh_current(_: np.ndarray, i: np.ndarray) -> tuple[complex, np.ndarray]:
    """``d|i| = Re(conj(i) di) / |i|``."""
    size = abs(i)
    return 0.0, np.where(size > CURRENT_FLOOR, i.conj() / np.maximum(size, CURRENT_FLOOR), 0.0)


def _weigh_magnitude(u: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, complex]:
    """``d|u| = Re(conj(u) du) / |u|``."""
    return u.conj() / np.maximum(abs(u), VOLTAGE_FLOOR), 0.0


def _weigh_angle(u: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, complex]:
    """``d arg u = Im(conj(u) du) / |u|^2``, and ``Im a = Re(-j a)``."""
    least = np.maximum(abs(u), VOLTAGE_FLOOR)
    return u.conj() / least * (-1j / least), 0.0


# Powers are most rows; ``QuantityRows`` reads and weighs them all at once.
_READ: dict[Quantity, _Read] = {
    Quantity.CURRENT: lambda phasors, rows: abs(phasors.currents(rows)),
    Quantity.VM: lambda phasors, rows: phasors.magnitudes(rows),
    Quantity.VA: lambda phasors, rows: phasors.angles(rows),
    Quantity.I_REAL: lambda phasors, rows: phasors.currents(rows).real,
    Quantity.I_IMAG: lambda phasors, rows: phasors.currents(rows).imag,
}
_WEIGH: dict[Quantity, _Weigh] = {
    Quantity.CURRENT: _weigh_current,
    Quantity.VM: _weigh_magnitude,
    Quantity.VA: _weigh_angle,
    Quantity.I_REAL: lambda _, i: (0.0, 1.0),
    Quantity.I_IMAG: lambda _, i: (0.0, -1j),
}


class QuantityRows:
    """Rows that read ``quantity``, (n_row,), numbers of ``Quantity``."""

    def __init__(self, quantity: np.ndarray) -> None:
        self._is_reactive = quantity == int(Quantity.Q)
        rows = ((_READ[q], _WEIGH[q], np.flatnonzero(quantity == int(q))) for q in _READ)
        self._no_power = [of_quantity for of_quantity in rows if of_quantity[-1].size]

    def read(self, phasors: Phasors) -> np.ndarray:
        """h of the rows, (n_row,)."""
        h: np.ndarray = np.where(self._is_reactive, phasors.s.imag, phasors.s.real)
        for read, _, rows in self._no_power:
            h[rows] = read(phasors, rows)
        return h

    def weigh(self, u: np.ndarray, i: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``of_u`` and ``of_i`` of the rows, (n_row,), complex, in ``dh = Re(of_u du + of_i di)``.

        Of powers ``ds = conj(i) du + u conj(di)``, ``Re(u conj(di)) = Re(conj(u) di)`` and ``Im s = Re(-j s)``.
        """
        of_u, of_i = i.conj() * self._turn, u.conj() * self._turn_back
        with np.errstate(invalid="ignore"):  # nan voltages have nan derivatives, with which an iteration ends
            for _, weigh, rows in self._no_power:
                of_u[rows], of_i[rows] = weigh(u[rows], i[rows])
        return of_u, of_i

    @cached_property
    def _turn(self) -> np.ndarray:
        return np.where(self._is_reactive, -1j, 1.0)

    @cached_property
    def _turn_back(self) -> np.ndarray:
        return self._turn.conj()
