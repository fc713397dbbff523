"""Meters on a feeder whose power flow is known, and its areas by the buses where it is cut."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from dsse_core.grid.admittance import build_admittance
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.grid.measurement_model import build_measurement_model
from dsse_core.grid.network import Branch, Network
from dsse_core.grid.nodes import list_phases
from dsse_core.power_flow.newton_raphson import solve_power_flow

KIND = MeasurementKind
POWERS, FLOWS = (KIND.P_INJECTION, KIND.Q_INJECTION), (KIND.P_FLOW, KIND.Q_FLOW)
FORECAST = 0.3  # sigma of a load's forecast, of its power


def place_meters(network: Network, seed: int, decades: float | None, *, is_rich: bool) -> list[Measurement]:
    """Noisy readings. Rich: voltages everywhere, half of the flows, currents, phasors; else forecasts of loads, the
    flows at the head, a few voltages and flows. ``decades``: over which sigmas are spread, the largest 0.1 p.u.
    """
    rng = np.random.default_rng(seed)
    placed = [*_place_injections(network, is_rich), *_place_voltages(network, rng, is_rich)]
    placed += _place_on_branches(network, rng, is_rich)
    meters, sigma = [meter for meter, _ in placed], np.array([sigma for _, sigma in placed])
    found = solve_power_flow(network, tolerance=1e-12)
    exact = build_measurement_model(network, build_admittance(network), meters).predict(np.r_[found.va, found.vm])
    is_virtual = np.array([meter.source is Source.VIRTUAL for meter in meters])
    assert abs(exact[is_virtual]).max() < 1e-6
    if decades is not None:
        sigma = np.where(is_virtual, 0.0, 10 ** rng.uniform(-1 - decades, -1, len(sigma)))
    z = np.where(is_virtual, 0.0, exact + sigma * rng.standard_normal(len(sigma)))
    readings = [Measurement(m, *of) for m, *of in zip(meters, z.tolist(), sigma.tolist(), strict=True)]
    is_small = np.array([meter.kind is KIND.CURRENT for meter in meters]) & (abs(exact) < 5 * sigma)
    return [m for m, small in zip(readings, is_small, strict=True) if not small]


def _place_injections(network: Network, is_rich: bool) -> Iterator[tuple[Meter, float]]:
    """P and Q of each node, of a single leg between phases in its place; 0 where no load is; the sum of currents of
    buses with such legs only.
    """
    assert network.slack is not None
    for bus in network.buses:
        legs: dict[str, complex] = {}
        for load in network.loads:
            if load.bus == bus.id:
                legs[load.phases] = legs.get(load.phases, 0) + load.s
        if bus.id == network.slack.bus:
            continue
        are_between = bool(legs) and all(len(list_phases(leg)) == 2 for leg in legs)
        if are_between:
            yield from ((Meter(kind, bus.id, source=Source.VIRTUAL), 0.0) for kind in (KIND.I_REAL, KIND.I_IMAG))
        is_one = are_between and len(legs) == 1
        metered = dict(legs) if is_one else _sum_by_node(legs)
        of_one = {*list_phases(next(iter(legs)))} if is_one else set()
        for place in [*metered, *(p for p in list_phases(bus.phases) if p not in metered and p not in of_one)]:
            s = metered.get(place)
            sigma = 0.0 if s is None else 3e-3 if is_rich else FORECAST * max(abs(s), 1e-3)
            source = Source.VIRTUAL if s is None else Source.TELEMETERED
            yield from ((Meter(kind, bus.id, phases=place, source=source), sigma) for kind in POWERS)


def _sum_by_node(legs: dict[str, complex]) -> dict[str, complex]:
    found: dict[str, complex] = {}
    for leg, s in legs.items():
        for phase in list_phases(leg):
            found[phase] = found.get(phase, 0) + s
    return found


def _place_voltages(network: Network, rng: np.random.Generator, is_rich: bool) -> Iterator[tuple[Meter, float]]:
    assert network.slack is not None
    for bus in network.buses:
        phases = list_phases(bus.phases)
        if bus.id in network.gauge.ungrounded:
            phases = [one + other for one, other in zip(phases, [*phases[1:], phases[0]], strict=True)]
        chosen = rng.random(len(phases)) < 0.08
        for place, is_chosen in zip(phases, chosen.tolist(), strict=True):
            if is_rich or is_chosen or bus.id == network.slack.bus:
                yield Meter(KIND.VM, bus.id, phases=place), 1e-3
        if is_rich and rng.random() < 0.15:
            yield from ((Meter(KIND.VA, bus.id, phases=place), 1e-3) for place in phases)


def _place_on_branches(network: Network, rng: np.random.Generator, is_rich: bool) -> Iterator[tuple[Meter, float]]:
    assert network.slack is not None
    for branch in network.branches:
        assert branch.primitive is not None
        phases = list_phases(branch.primitive.from_phases)
        is_head, chosen = branch.from_bus == network.slack.bus, rng.random()
        kinds: tuple[MeasurementKind, ...] = ()
        if is_head or chosen < (0.5 if is_rich else 0.05):
            kinds = FLOWS
        elif is_rich and chosen < 0.7:
            kinds = (KIND.CURRENT,)
        yield from ((Meter(kind, branch.from_bus, branch.id, phases=p), 2e-3) for p in phases for kind in kinds)


def cut_at(network: Network, cuts: Collection[int], apart: Collection[int] = ()) -> dict[str, list[int]]:
    """Area -> its buses: at each of ``cuts`` begins an area, at each of those ``apart`` one for each branch there."""
    assert network.slack is not None
    area, beside = {network.slack.bus: "head"}, network.branches_at
    areas: dict[str, list[int]] = {"head": [network.slack.bus]}
    queue = [network.slack.bus]
    for bus in queue:  # the queue grows
        for branch in beside[bus]:
            other = branch.other_end(bus)
            if other in area:
                continue
            area[other] = _area_below(bus, branch, area[bus], cuts, apart)
            areas.setdefault(area[other], [bus]).append(other)
            queue.append(other)
    return areas


def _area_below(bus: int, branch: Branch, above: str, cuts: Collection[int], apart: Collection[int]) -> str:
    return f"at{bus}_{branch.other_end(bus)}" if bus in apart else f"at{bus}" if bus in cuts else above
