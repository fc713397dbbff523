"""Primitive admittances of lines and of transformer banks, p.u. of a third of the power base.

Voltages are those of nodes to ground: the winding of a bank between two conductors has 3^0.5 p.u. at nominal voltage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dsse_core.grid.nodes import Primitive, list_phases

Connection = Literal["grounded", "wye", "delta", "delta reversed"]
NEUTRAL = "n"  # the star point of a bank that nothing but its windings touches


@dataclass(frozen=True)
class Side:
    """One side of a bank: the bus' ``phases``, and of each unit where its winding stands, and its turns.

    ``legs``: "a" from a to ground, "ab" from a to b, "an" from a to the star point. ``turns`` (n_unit,): voltages
    across the windings without load, p.u.; with a tap per phase each has its own.
    """

    phases: str
    legs: tuple[str, ...]
    turns: tuple[float, ...]


def connect(phases: str, connection: Connection, taps: Sequence[float] | float = 1.0) -> Side:
    """The side of a bank of a unit for each phase at nominal voltage times ``taps``.

    Units of "delta" stand from each phase to the next, of "delta reversed" to the one before: with a wye on the other
    side this one lags by 30 degrees, or leads.
    """
    names, tap = list_phases(phases), np.broadcast_to(taps, len(list_phases(phases)))
    if connection == "grounded":
        return Side(phases, tuple(names), tuple(tap.tolist()))
    if connection == "wye":
        return Side(phases, tuple(name + NEUTRAL for name in names), tuple(tap.tolist()))
    others = np.roll(names, -1 if connection == "delta" else 1).tolist()
    legs = tuple(name + other for name, other in zip(names, others, strict=True))
    return Side(phases, legs, tuple((np.sqrt(3) * tap).tolist()))


def build_line(phases: str, z: np.ndarray, charging: np.ndarray | float = 0.0) -> Primitive:
    """A line of ``phases``: [[Zi + Yc/2, -Zi], [-Zi, Zi + Yc/2]], Zi the inverse of its series impedances ``z``.

    ``z``, ``charging`` (Yc): complex, p.u., (k, k).
    """
    inverse = np.linalg.inv(z)
    at_ends = np.kron(np.eye(2), np.broadcast_to(charging, inverse.shape) / 2)
    return Primitive(phases, phases, np.kron([[1, -1], [-1, 1]], inverse) + at_ends, at_ends)


def find_size(primitive: Primitive) -> complex:
    """The size of a branch as an impedance, p.u., by which those near zero are found: of its from end, at the mean."""
    n = len(list_phases(primitive.from_phases))
    size = complex((primitive.y - primitive.charging).diagonal()[:n].sum())
    return n / size if size else 1.0 + 0j


def build_bank(at_from: Side, at_to: Side, y: complex, idle: complex = 0j) -> Primitive:
    """A bank of equal two-winding units: sum of N' [[y, -y], [-y, y]] N, without the star points.

    Each unit's N has a row for each winding, 1 / turns at the conductor where it begins and -1 / turns where it ends.
    ``y``: the admittance of a unit, p.u.: for three units of a bank of S and z p.u. it is S / (power base) / z.
    ``idle``: the admittance of its magnetising branch, p.u., which stands across the winding at the to side.
    """
    windings = (0, at_from), (1, at_to)
    return _build_windings(at_from.phases, at_to.phases, windings, y * np.array([[1, -1], [-1, 1]]), idle)


def build_centre_tapped(at_from: Side, at_to: Side, z: complex, idle: complex = 0j) -> Primitive:
    """One unit with two equal halves of a winding at its to side, from s1 to the ground and from there to s2.

    ``z``, p.u.: the impedance with both halves in series. Interlaced halves of it have (Kersting, Distribution System
    Modeling and Analysis, 11.1) R/2 + 0.8 jX at the from side and R + 0.4 jX in each half. ``idle``: as in
    ``build_bank``, across the half at s1.
    """
    one, half = complex(z.real / 2, 0.8 * z.imag), complex(z.real, 0.4 * z.imag)
    of_halves = np.array([[1, 1], [-1, 0], [0, -1]])  # currents of the windings for those of the halves
    y = of_halves @ np.linalg.inv(np.array([[one + half, one], [one, one + half]])) @ of_halves.T
    halves = (Side(at_to.phases, ("s1",), at_to.turns), Side(at_to.phases, ("s2",), (-at_to.turns[0],)))
    return _build_windings(at_from.phases, at_to.phases, ((0, at_from), *((1, half) for half in halves)), y, idle)


def _build_windings(
    from_phases: str, to_phases: str, windings: Sequence[tuple[int, Side]], y: np.ndarray, idle: complex
) -> Primitive:
    """Equal units of windings, each at the from (0) or to side (1); ``y``: the admittance of a unit over these;
    ``idle``: a further one of its second winding, which draws current without load.
    """
    phases = from_phases, to_phases
    conductors = [(k, name) for k in (0, 1) for name in [*list_phases(phases[k]), NEUTRAL]]
    N = np.zeros((len(windings[0][1].legs), len(windings), len(conductors)))
    for winding, (k, side) in enumerate(windings):
        for unit, (leg, turns) in enumerate(zip(side.legs, side.turns, strict=True)):
            ends = [*list_phases(leg.removesuffix(NEUTRAL)), *([NEUTRAL] if leg.endswith(NEUTRAL) else [])]
            for sign, name in zip((1, -1), ends, strict=False):
                N[unit, winding, conductors.index((k, name))] = sign / turns
    is_star = np.array([name == NEUTRAL for _, name in conductors])

    def reduce(of_unit: np.ndarray) -> np.ndarray:
        Y = np.einsum("uwi,wv,uvj->ij", N, of_unit, N)
        of_star, between = Y[np.ix_(is_star, is_star)], Y[np.ix_(~is_star, is_star)]
        reduced: np.ndarray = Y[np.ix_(~is_star, ~is_star)] - between @ np.linalg.pinv(of_star) @ between.T
        return reduced

    loaded = reduce(y)
    if not idle:
        return Primitive(from_phases, to_phases, loaded, np.zeros_like(loaded))
    whole = reduce(y + idle * np.diag(np.arange(len(y)) == 1))
    return Primitive(from_phases, to_phases, whole, whole - loaded)
