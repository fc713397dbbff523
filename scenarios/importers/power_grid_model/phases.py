"""Branches and appliances of power-grid-model's asymmetric calculation: three phases at every node, from sequences."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from dsse_core.grid.loads import Load
from dsse_core.grid.nodes import Primitive
from dsse_core.grid.primitives import build_line
from scenarios.importers.power_grid_model.branches import PiModel, find_rated_voltages
from scenarios.importers.power_grid_model.data import APPLIANCES, ASYMMETRIC, Data, rows
from scenarios.importers.sequences import ABC, join_sequences, spread

BASE_VA = 1e6
GROUNDED_WYE, DELTA, GROUNDED_ZIGZAG = 1, 2, 4
ZIGZAG = 0.1  # share of the positive sequence impedance that a zigzag winding has to the zero sequence
LOW_SUSCEPTANCE = -1e-8j  # share of the rated admittance that power-grid-model adds where a zero sequence has no path
HALF_TURN = (2, 6, 10)  # clocks of two grounded wyes, one of them reversed
EXPONENTS = {0: (0.0, 0.0), 1: (2.0, 2.0), 2: (1.0, 1.0)}
"""Type of a load or generator -> exponents of P and Q."""


def build_three_phases(name: str, component: Any, pi: PiModel, kv: tuple[float, float], hz: float) -> Primitive:
    """The admittances between the phases of a ``line`` or ``transformer``, whose positive sequence is ``pi``."""
    y1, shunt = 1 / complex(pi.r, pi.x), complex(pi.g, pi.b)
    if name == "line":
        z0 = complex(component["r0"], component["x0"]) / kv[0] ** 2
        b0 = 2 * math.pi * hz * float(component["c0"]) * kv[0] ** 2
        return build_line(ABC, spread(1 / y1, z0), spread(shunt, b0 * complex(float(component["tan0"]), 1.0)))
    ratio = cmath.rect(pi.tap, pi.shift)
    sequences = [
        _build_zero_sequence(component, y1, pi.tap, kv),
        _build_two_port(y1, shunt, ratio),
        _build_two_port(y1, shunt, ratio.conjugate()),
    ]
    return Primitive(ABC, ABC, join_sequences(np.array(sequences)), np.zeros((6, 6)))


def _build_two_port(y: complex, shunt: complex, ratio: complex) -> np.ndarray:
    at_to = y + shunt / 2
    return np.array([[at_to / abs(ratio) ** 2, -y / ratio.conjugate()], [-y / ratio, at_to]])


def _build_zero_sequence(t: Any, y: complex, tap: float, kv: tuple[float, float]) -> np.ndarray:
    """Zero sequence of a transformer (its documentation, "Components"), of ungrounded windings without susceptance.

    A grounded wye joins the one at the other side; to a delta its winding, else its magnetisation, goes to the ground.
    """
    shunt, (at_from, at_to) = _find_zero_shunt(t, kv[1]), (int(t["winding_from"]), int(t["winding_to"]))
    grounding = [
        3 * complex(*(_or_zero(t[f"{part}_grounding_{side}"]) for part in "rx")) / base**2
        for side, base in zip(("from", "to"), kv, strict=True)
    ]
    grounding[0] /= tap**2
    if at_from == at_to == GROUNDED_WYE:
        turned = -tap if int(t["clock"]) % 12 in HALF_TURN else tap
        return _build_two_port(1 / (1 / y + sum(grounding)), shunt, complex(turned))
    found = np.zeros((2, 2), dtype=complex)
    for side, (own, other) in enumerate(((at_from, at_to), (at_to, at_from))):
        to_ground = 0j
        if own == GROUNDED_WYE and other != GROUNDED_WYE:
            to_ground = shunt + (y if other == DELTA else LOW_SUSCEPTANCE * float(t["sn"]) / BASE_VA / float(t["uk"]))
        elif own == GROUNDED_ZIGZAG:
            to_ground = y / ZIGZAG
        if to_ground:
            found[side, side] = 1 / (1 / to_ground + grounding[side])
    found[0, 0] /= tap**2
    return found


def _find_zero_shunt(t: Any, to_kv: float) -> complex:
    _, u2 = find_rated_voltages(t)
    i0, p0 = float(t["i0"]), float(t["p0"])
    i00 = i0 if math.isnan(t["i0_zero_sequence"]) else float(t["i0_zero_sequence"])
    own = float(t["p0_zero_sequence"])
    p00 = p0 + float(t["pk"]) * (i00**2 - i0**2) if math.isnan(own) else own
    g, size = p00 / u2**2, i00 * float(t["sn"]) / u2**2
    return complex(g, -math.sqrt(max(size**2 - g**2, 0.0))) * to_kv**2


def _or_zero(value: Any) -> float:
    return 0.0 if math.isnan(value) else float(value)


def list_legs(data: Data, bus_of: dict[int, int]) -> Iterator[Load]:
    """Loads and generators in service, a leg from each phase to the ground."""
    for name, sign in APPLIANCES.items():
        for a in rows(data, name):
            if a["status"]:
                share = BASE_VA / 3 if name in ASYMMETRIC else BASE_VA
                p, q = (np.nan_to_num(np.broadcast_to(a[f"{part}_specified"], 3)) / share for part in "pq")
                for phase, s in zip(ABC, -sign * (p + 1j * q), strict=True):
                    yield Load(bus_of[int(a["node"])], phase, complex(s), EXPONENTS[int(a["type"])])
