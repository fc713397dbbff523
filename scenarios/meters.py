"""Which meters a scenario has, and the standard deviation of each."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.grid.network import Network
from scenarios.files.scenario_file import MeasurementsTable, SigmaTable

KIND = MeasurementKind
Place = TypeVar("Place", int, str)
NUMBER_OF = {id(kind): k for k, kind in enumerate(KIND)}
"""Members are singletons, and hashing half a million of them takes long."""


def number_kinds(meters: Sequence[Meter]) -> np.ndarray:
    """The position of each meter's kind in ``MeasurementKind``, shape (n_meas,)."""
    return np.array([NUMBER_OF[id(meter.kind)] for meter in meters], dtype=np.intp)


@dataclass(frozen=True)
class SigmaRule:
    """Standard deviation by kind of meter: ``relative`` to the true value, or ``absolute`` in p.u. (rad for angles).

    The relative sigma of an active or reactive power refers to the apparent power at that place. Relative sigmas
    of powers and currents are at least ``floor`` (p.u.; for currents, of that power at 1 p.u. voltage).
    """

    relative: dict[MeasurementKind, float]
    absolute: dict[MeasurementKind, float]
    floor: float

    def sigmas(self, meters: Sequence[Meter], size: np.ndarray) -> np.ndarray:
        """Standard deviations of ``meters``, p.u. or rad, shape (n_meas,); 0 of virtual ones.

        ``size``: of each the size of the true value, of a power that of the apparent power at its place.

        Raises:
            KeyError: there is no rule for a kind of meter.
        """
        kinds = number_kinds(meters)
        virtual = np.array([meter.source is Source.VIRTUAL for meter in meters], dtype=bool)
        ruled = self.relative.keys() | self.absolute.keys()
        if unruled := {kind for k, kind in enumerate(KIND) if (kinds[~virtual] == k).any()} - ruled:
            raise KeyError(min(unruled))
        sigma = np.zeros(len(meters))
        for kind in ruled:
            of_kind = kinds == NUMBER_OF[id(kind)]
            if kind in self.absolute:
                sigma[of_kind] = self.absolute[kind]
            else:
                least = 0.0 if kind is KIND.VM else self.floor
                sigma[of_kind] = np.maximum(self.relative[kind] * size[of_kind], least)
        sigma[virtual] = 0.0
        return sigma


def build_sigma_rule(table: MeasurementsTable, base_mva: float) -> SigmaRule:
    """The sigmas of a scenario file, in p.u. and rad."""
    by_kind: dict[MeasurementKind, SigmaTable | None] = {
        KIND.VM: table.voltage,
        KIND.P_FLOW: table.flow,
        KIND.Q_FLOW: table.flow,
        KIND.P_INJECTION: table.injection,
        KIND.Q_INJECTION: table.injection,
        KIND.CURRENT: table.current,
    }
    relative = {k: t.sigma_percent / 100 for k, t in by_kind.items() if t and t.sigma_percent is not None}
    absolute = {k: t.sigma_pu for k, t in by_kind.items() if t and t.sigma_pu is not None}
    if table.angle:
        absolute[KIND.VA] = math.radians(table.angle.sigma_deg)
    return SigmaRule(relative, absolute, table.floor_kva / 1000 / base_mva)


def build_meters(table: MeasurementsTable, network: Network) -> tuple[Meter, ...]:
    """The meters of a scenario file on ``network``; unknown places are left out (``find_place_problems`` tells).

    A bus without load and source injects nothing: under ``zero_injection = "virtual"`` it gets that as an exact
    constraint, and no ordinary injection meter.
    """
    all_buses = tuple(network.row)
    all_branches = tuple(branch.id for branch in network.active_branches)
    meters: list[Meter] = []
    if table.voltage:
        meters += [Meter(KIND.VM, bus) for bus in _known(table.voltage.buses, all_buses)]
    if table.angle:
        meters += [Meter(KIND.VA, bus) for bus in _known(table.angle.buses, all_buses)]
    if table.flow:
        branches = [network.branch(b) for b in _known(table.flow.branches, all_branches)]
        flows = (KIND.P_FLOW, KIND.Q_FLOW)
        meters += [Meter(kind, b.from_bus, b.id) for b in branches for kind in flows]
    if table.current:
        branches = [network.branch(b) for b in _known(table.current.branches, all_branches)]
        meters += [Meter(KIND.CURRENT, b.from_bus, b.id) for b in branches]
    virtual = find_virtual_buses(table, network)
    measured = _known(table.injection.buses, all_buses) if table.injection else ()
    injections = (KIND.P_INJECTION, KIND.Q_INJECTION)
    meters += [Meter(kind, bus) for bus in measured if bus not in virtual for kind in injections]
    meters += [Meter(kind, bus, source=Source.VIRTUAL) for bus in virtual for kind in injections]
    return tuple(meters)


def find_place_problems(table: MeasurementsTable, network: Network) -> Iterable[str]:
    """Every bus and branch of ``table`` that is unknown, out of service or listed twice, with its key."""
    for key in ("voltage", "angle", "injection"):
        buses: tuple[int, ...] | None = (part := getattr(table, key)) and part.buses
        for bus, count in sorted(Counter(buses or ()).items()):
            if bus not in network.row:
                yield f"measurements.{key}.buses: bus {bus} is not in network {network.name!r}"
            if count > 1:
                yield f"measurements.{key}.buses: bus {bus} is listed twice; keep one"
    yield from _find_zero_injection_problems(table, network)
    in_service = {branch.id: branch.in_service for branch in network.branches}
    for key in ("flow", "current"):
        branches: tuple[str, ...] | None = (part := getattr(table, key)) and part.branches
        for branch, count in sorted(Counter(branches or ()).items()):
            if branch not in in_service:
                yield (
                    f"measurements.{key}.branches: branch {branch!r} is not in network {network.name!r}; "
                    "a branch is called FROM-TO unless the network file gives it an id"
                )
            elif not in_service[branch]:
                yield f"measurements.{key}.branches: branch {branch!r} is out of service; remove it from the list"
            if count > 1:
                yield f"measurements.{key}.branches: branch {branch!r} is listed twice; keep one"


def _find_zero_injection_problems(table: MeasurementsTable, network: Network) -> Iterable[str]:
    listed = table.zero_injection if isinstance(table.zero_injection, tuple) else ()
    empty = _find_zero_injections(network)
    for bus, count in sorted(Counter(listed).items()):
        if bus not in network.row:
            yield f"measurements.zero_injection: bus {bus} is not in network {network.name!r}"
        elif bus not in empty:
            yield f"measurements.zero_injection: bus {bus} has a load or a source in the network file; remove it here"
        if count > 1:
            yield f"measurements.zero_injection: bus {bus} is listed twice; keep one"


def _known(listed: Sequence[Place] | None, places: Sequence[Place]) -> Sequence[Place]:
    """The listed places that exist, each once; all places if none is listed."""
    if listed is None:
        return places
    existing = set(places)
    return [place for place in dict.fromkeys(listed) if place in existing]


def find_virtual_buses(table: MeasurementsTable, network: Network) -> dict[int, None]:
    """The buses that inject exactly nothing, for every estimator."""
    empty = _find_zero_injections(network)
    if table.zero_injection == "virtual":
        return empty
    return {} if table.zero_injection == "measured" else {b: None for b in table.zero_injection if b in empty}


def _find_zero_injections(network: Network) -> dict[int, None]:
    """Buses without load and source; a shunt is part of the network, not an injection."""
    fed = {generator.bus for generator in network.generators}
    return {b.id: None for b in network.buses if b.p_load == 0 and b.q_load == 0 and b.id not in fed}
