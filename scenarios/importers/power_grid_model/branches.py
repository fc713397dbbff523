"""power-grid-model's branches as pi models in p.u. on 1 MVA: lines, transformers, generic branches."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from scenarios.importers.imported import current_rating, rating

UNSET_INT8 = -128


class PiModel(NamedTuple):
    """The electric part of a ``Branch``, its series impedance behind the tap, p.u. and rad."""

    r: float
    x: float
    b: float
    g: float
    tap: float = 1.0
    shift: float = 0.0


def build_line(line: Any, from_kv: float, _to_kv: float, frequency_hz: float) -> PiModel:
    """Series ``r1 + j x1``; shunt ``2 pi f c1 (tan1 + j)``."""
    z_base = from_kv**2
    b = 2 * math.pi * frequency_hz * float(line["c1"]) * z_base
    return PiModel(r=float(line["r1"]) / z_base, x=float(line["x1"]) / z_base, b=b, g=b * float(line["tan1"]))


def build_generic_branch(branch: Any, _from_kv: float, to_kv: float, _frequency_hz: float) -> PiModel:
    """A pi model in ohm and siemens of the to side, behind the ratio ``k exp(j theta)``."""
    z_base = to_kv**2
    k, theta = float(branch["k"]), float(branch["theta"])
    return PiModel(
        r=float(branch["r1"]) / z_base,
        x=float(branch["x1"]) / z_base,
        b=float(branch["b1"]) * z_base,
        g=float(branch["g1"]) * z_base,
        tap=1.0 if math.isnan(k) else k,
        shift=0.0 if math.isnan(theta) else theta,
    )


def build_transformer(t: Any, from_kv: float, to_kv: float, _frequency_hz: float) -> PiModel:
    """Name-plate values as a pi model at the to side: ``|z| = uk u2^2 / sn``, ``r = pk u2^2 / sn^2``,
    ``|y| = i0 sn / u2^2``, ``g = p0 / u2^2``; the tap changes the rated voltage of its side.
    """
    (u1, u2), sn, (nominal, position) = find_rated_voltages(t), float(t["sn"]), _find_tap(t)
    z_base = u2**2 / sn
    z = _at_tap(t, "uk", position, nominal) * z_base
    r = _at_tap(t, "pk", position, nominal) / sn * z_base
    g = float(t["p0"]) / u2**2
    b = -math.sqrt(max((float(t["i0"]) * sn / u2**2) ** 2 - g**2, 0.0))
    base = to_kv**2
    return PiModel(
        r=r / base,
        x=math.sqrt(max(z**2 - r**2, 0.0)) / base,
        b=b * base,
        g=g * base,
        tap=(u1 / u2) / (from_kv / to_kv),
        shift=math.radians(30.0 * int(t["clock"])),
    )


def find_rated_voltages(t: Any) -> tuple[float, float]:
    """Rated voltages of both sides at the tap, V."""
    u1, u2, (nominal, position) = float(t["u1"]), float(t["u2"]), _find_tap(t)
    rising = 1 if int(t["tap_max"]) > int(t["tap_min"]) else -1
    change = rising * (position - nominal) * float(t["tap_size"])
    return (u1 + change, u2) if int(t["tap_side"]) == 0 else (u1, u2 + change)


def _find_tap(t: Any) -> tuple[int, int]:
    """Nominal and present position."""
    nominal = int(t["tap_nom"]) if int(t["tap_nom"]) != UNSET_INT8 else 0
    return nominal, int(t["tap_pos"]) if int(t["tap_pos"]) != UNSET_INT8 else nominal


def _at_tap(t: Any, key: str, position: int, nominal: int) -> float:
    """``uk`` or ``pk`` at the tap, linear between the nominal and the outermost positions, where they are given."""
    value = float(t[key])
    towards_max = (position - nominal) * (int(t["tap_max"]) - nominal) > 0
    outer = float(t[f"{key}_max" if towards_max else f"{key}_min"])
    span = (int(t["tap_max"]) if towards_max else int(t["tap_min"])) - nominal
    if position == nominal or math.isnan(outer) or span == 0:
        return value
    return value + (position - nominal) / span * (outer - value)


def find_rating(name: str, component: Any, from_kv: float, to_kv: float) -> dict[str, Any]:
    """``i_max`` of a line, ``s_max`` of others, in p.u. on 1 MVA, from a row and the nominal voltages of its nodes."""
    if name == "line":
        return current_rating(float(component["i_n"]) / 1000, from_kv, to_kv, 1.0)
    return {"s_max": rating(float(component["sn"]) / 1e6, 1.0)}


BUILDERS: dict[str, Callable[[Any, float, float, float], PiModel]] = {
    "line": build_line,
    "transformer": build_transformer,
    "generic_branch": build_generic_branch,
}
"""Component -> its model, from its row, the nominal voltages (kV) of its nodes and the frequency (Hz)."""
