"""Buses and branches of a network file as columns, in per unit and radians, from either form of the file."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from itertools import count
from typing import Any

import numpy as np

from dsse_core.grid.columns import Records, Rows, read_ids
from dsse_core.grid.network import Branch, Bus
from dsse_core.grid.nodes import Primitive, share_of_power
from dsse_core.results.units import base_current
from scenarios.files.network_tables import BranchColumns, BranchTable, BusColumns, BusTable


@dataclass(frozen=True)
class BusArrays:
    """``base_kv`` in kV, powers and shunts in p.u.; shape (n_bus,) each. ``x``, ``y``: NaN where not known."""

    id: np.ndarray
    name: list[str]
    base_kv: np.ndarray
    p_load: np.ndarray
    q_load: np.ndarray
    g_shunt: np.ndarray
    b_shunt: np.ndarray
    x: np.ndarray
    y: np.ndarray
    phases: list[str]

    @classmethod
    def of(cls, given: list[BusTable] | BusColumns, base_mva: float) -> BusArrays:
        n = len(given) if isinstance(given, list) else len(given.id)
        powers = ("p_load_mw", "q_load_mvar", "g_shunt_mw", "b_shunt_mvar")
        scaled = [np.array(_take(given, key, n, 0.0), dtype=float) / base_mva for key in powers]
        base_kv = np.array(_take(given, "base_kv", n, math.nan), dtype=float)
        phases = _take(given, "phases", n, "")
        if any(phases):
            share = np.array([share_of_power(text) for text in phases])
            scaled = [power / share for power in scaled]
        place = [np.array([math.nan if v is None else v for v in _take(given, key, n, None)]) for key in ("x", "y")]
        p, q, g, b = scaled
        ids, names = read_ids(_take(given, "id", n, 0)), _take(given, "name", n, "")
        x, y = place
        return cls(ids, names, base_kv, p, q, g, b, x, y, phases)

    def build(self) -> Records[Bus]:
        columns = {field.name: getattr(self, field.name) for field in fields(Bus) if hasattr(self, field.name)}
        if not any(self.phases):
            del columns["phases"]
        return Records(Bus, _without_unknown(columns, ("x", "y")))


@dataclass(frozen=True)
class BranchArrays:
    """P.u. and rad; shape (n_branch,) each. ``id``: empty or None where a branch is called by its ends.

    ``i_max``, ``s_max``: NaN where a branch has no such rating. ``in_ohm``: true where the file gives the impedance in
    ohm; ``from_kv``, ``to_kv``: nominal voltages there, NaN of a bus that is not defined.
    """

    id: list[str | None]
    from_bus: np.ndarray
    to_bus: np.ndarray
    r: np.ndarray
    x: np.ndarray
    b: np.ndarray
    tap: np.ndarray
    tap_steps: np.ndarray
    estimate_tap: np.ndarray
    shift: np.ndarray
    in_service: np.ndarray
    switch: np.ndarray
    g: np.ndarray
    name: list[str]
    i_max: np.ndarray
    s_max: np.ndarray
    in_ohm: np.ndarray
    from_kv: np.ndarray
    to_kv: np.ndarray

    @classmethod
    def of(cls, given: list[BranchTable] | BranchColumns, buses: BusArrays, base_mva: float) -> BranchArrays:
        n = len(given) if isinstance(given, list) else len(given.to)
        from_bus, to_bus = read_ids(_take(given, "from_", n, 0)), read_ids(_take(given, "to", n, 0))
        in_ohm = np.array(
            [b.is_in_ohm for b in given] if isinstance(given, list) else [given.is_in_ohm] * n, dtype=bool
        )
        rows, base_kv = Rows(buses.id), np.append(buses.base_kv, math.nan)  # row -1: the bus is not defined
        from_kv, to_kv = base_kv[rows.find(from_bus)], base_kv[rows.find(to_bus)]
        kv = np.where(np.isnan(from_kv), 1.0, from_kv)  # 1.0 for a bus that is not defined; Network reports the bus
        z_base = np.where(in_ohm, kv * kv / base_mva, 1.0)

        def take(key: str, default: float = 0.0) -> np.ndarray:
            return np.array(_take(given, key, n, default), dtype=float)

        def choose(ohm: np.ndarray, pu: str) -> np.ndarray:
            return np.where(in_ohm, ohm, take(pu))

        return cls(
            _take(given, "id", n, None),
            from_bus,
            to_bus,
            r=choose(take("r_ohm") / z_base, "r_pu"),
            x=choose(take("x_ohm") / z_base, "x_pu"),
            b=choose(take("b_us") * 1e-6 * z_base, "b_pu"),
            tap=take("tap_ratio", 1.0),
            tap_steps=take("tap_steps"),
            estimate_tap=np.array(_take(given, "estimate_tap", n, False), dtype=bool),
            shift=np.radians(take("shift_deg")),
            in_service=np.array(_take(given, "in_service", n, True), dtype=bool),
            switch=np.array(_take(given, "switch", n, False), dtype=bool),
            g=choose(take("g_us") * 1e-6 * z_base, "g_pu"),
            name=_take(given, "name", n, ""),
            i_max=take("rating_a", math.nan) * kv / base_current(base_mva, 1.0),
            s_max=take("rating_mva", math.nan) / base_mva,
            in_ohm=in_ohm,
            from_kv=from_kv,
            to_kv=to_kv,
        )

    def build(self, primitives: Sequence[Primitive] = ()) -> Records[Branch]:
        """The branches; ``primitives``: their admittances, of a network with phases."""
        columns = {field.name: getattr(self, field.name) for field in fields(Branch) if hasattr(self, field.name)}
        if primitives:
            columns["primitive"] = primitives
        for key in ("tap_steps", "estimate_tap", "switch"):
            if not columns[key].any():
                del columns[key]
        return Records(Branch, _without_unknown(columns, ("i_max", "s_max")) | {"id": self._name()})

    def _name(self) -> list[str]:
        """The id of each branch: the one given, or its ends."""
        ends = self.from_bus.tolist(), self.to_bus.tolist()
        names = [given or f"{from_bus}-{to_bus}" for given, from_bus, to_bus in zip(self.id, *ends, strict=True)]
        if len(set(names)) == len(names):
            return names
        taken: set[str | None] = set(self.id)
        for k, (given, from_bus, to_bus) in enumerate(zip(self.id, *ends, strict=True)):
            names[k] = given or default_branch_id(from_bus, to_bus, taken)
            taken.add(names[k])
        return names


def _take(given: Sequence[object] | object, key: str, n: int, default: object) -> list:  # type: ignore[type-arg]
    """The values of a key of all items, ``default`` where it is not given."""
    if isinstance(given, list):
        return [default if (value := getattr(item, key)) is None else value for item in given]
    column = getattr(given, key)
    return [default] * n if column is None else column


def _without_unknown(columns: dict[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """``columns``, those of ``keys`` with None for NaN, or left out where all is NaN."""
    known = {key: columns[key] for key in keys if not np.isnan(columns[key]).all()}
    found = {key: [None if math.isnan(value) else value for value in column.tolist()] for key, column in known.items()}
    return {key: column for key, column in columns.items() if key not in keys} | found


def default_branch_id(from_bus: int, to_bus: int, taken: Collection[str | None]) -> str:
    """``from-to``; parallel branches get ``#2``, ``#3``, ... behind it. ``taken``: the ids of others."""
    plain = f"{from_bus}-{to_bus}"
    if plain not in taken:
        return plain
    return next(branch_id for number in count(2) if (branch_id := f"{plain}#{number}") not in taken)
