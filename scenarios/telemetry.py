"""Telemetry: what the meters of every area read in one scan, made from the truth, noise and gross errors, or real."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dsse_core.boundary_load import boundary_loads, scheduled_load_messages
from dsse_core.errors import InvalidInputError
from dsse_core.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.power_flow import PowerFlowResult, solve_power_flow
from scenarios.meter_noise import draw_noise
from scenarios.meters import other_power
from scenarios.scenario import Scenario


@dataclass(frozen=True)
class Telemetry:
    """One scan. ``by_area``: area -> its measurements; ``union``: all of them, for the centralised WLS.

    ``truth`` is the power flow of the whole grid, None where the readings are real. ``area_power_flows``: those that
    the readings come from under ``area-power-flow`` (their angles refer to each area's local slack), else empty.
    """

    truth: PowerFlowResult | None
    by_area: dict[str, tuple[Measurement, ...]]
    union: tuple[Measurement, ...]
    area_power_flows: dict[str, PowerFlowResult]


def make_telemetry(scenario: Scenario, scan: int = 1) -> Telemetry:
    """Readings of all meters in scan number ``scan``: the same for the same scenario, seed and scan.

    A meter's noise depends on seed, scan and its own id only, not on which other meters there are.

    Raises:
        InvalidInputError: ``area-power-flow`` and an area without local slack voltage.
        PowerFlowDivergedError: the grid, or an area by itself, has no power flow solution.
    """
    meters_by_area = scenario.partition.meters_by_area(scenario.meters)
    truth, area_power_flows = None, {}
    if scenario.telemetry.source == "file":
        union = tuple(_real_reading(scenario, meter) for meter in scenario.meters)
    else:
        truth = solve_power_flow(scenario.network)
        exact: dict[str, float] = {}
        if scenario.telemetry.source == "area-power-flow":
            area_power_flows = _solve_area_power_flows(scenario)
            for name, power_flow in area_power_flows.items():
                exact |= _read_exactly(power_flow, meters_by_area[name])
        else:
            exact = _read_exactly(truth, scenario.meters)
        noise = _draw_noise(scenario, scan)
        union = tuple(_read(scenario, meter, exact, noise.get(meter.id, 0.0)) for meter in scenario.meters)
    union = tuple(m for m in union if not _is_missing(scenario, scan, m.meter))
    reading = {measurement.meter: measurement for measurement in union}
    by_area = {name: tuple(reading[m] for m in meters if m in reading) for name, meters in meters_by_area.items()}
    return Telemetry(truth, by_area, union, area_power_flows)


def find_lateness(scenario: Scenario, scan: int) -> dict[str, float]:
    """Area -> by how many seconds the readings of ``scan`` reach it late, by the scenario's faults of telemetry."""
    faults = scenario.faults.telemetry
    lateness = {}
    for area in scenario.partition.areas:
        late, share = _draw(scenario, scan, area.name, 2)
        if late < faults.late:
            lateness[area.name] = float(share) * faults.late_s
    return lateness


def _is_missing(scenario: Scenario, scan: int, meter: Meter) -> bool:
    missing = scenario.faults.telemetry.missing
    return missing > 0 and meter.source is not Source.VIRTUAL and _draw(scenario, scan, meter.id, 1)[0] < missing


def _draw(scenario: Scenario, scan: int, name: str, count: int) -> np.ndarray:
    """Uniform numbers that belong to one meter or area in one scan, apart from the meter's noise."""
    return np.random.default_rng([scenario.seed, scan, zlib.crc32(name.encode()), 1]).random(count)


def find_missing_local_slacks(scenario: Scenario) -> list[str]:
    """Areas that ``area-power-flow`` cannot solve by themselves, as text that says what to add."""
    return [
        f"areas.{area.name}: telemetry.source 'area-power-flow' needs a voltage at its local slack bus "
        f"{area.slack_bus}; give slack_bus and slack_vm_pu"
        for area in scenario.partition.areas
        if area.slack_vm is None and scenario.telemetry.source == "area-power-flow"
    ]


def _solve_area_power_flows(scenario: Scenario) -> dict[str, PowerFlowResult]:
    """Area -> its own power flow, the rest of the grid as scheduled net load at its boundary buses (eqs. 5.1-5.7)."""
    if problems := find_missing_local_slacks(scenario):
        raise InvalidInputError(f"scenario {scenario.name!r}", problems)
    heard = scheduled_load_messages(scenario.partition)
    results = {}
    for area in scenario.partition.areas:
        assert area.slack_vm is not None  # find_missing_local_slacks
        loads = boundary_loads(area, heard[area.name], scenario.load_error[area.name])
        results[area.name] = solve_power_flow(
            area.network,
            slack=(area.slack_bus, area.slack_vm),
            extra_load={bus: load.s for bus, load in loads.items()},
        )
    return results


def _read_exactly(power_flow: PowerFlowResult, meters: Sequence[Meter]) -> dict[str, float]:
    """Id of each meter, and of the one of the other power at its place -> what it would read without error."""
    places = {m.id: m for meter in meters for m in (meter, other_power(meter))}
    return dict(zip(places, power_flow.read_all(list(places.values())).tolist(), strict=True))


def _real_reading(scenario: Scenario, meter: Meter) -> Measurement:
    if meter.source is Source.VIRTUAL:
        return Measurement(meter, 0.0, 0.0)
    real = scenario.telemetry.readings[meter.id]
    return replace(real, value=real.value + scenario.telemetry.gross_errors.get(meter.id, 0.0) * real.sigma)


def _draw_noise(scenario: Scenario, scan: int) -> dict[str, float]:
    """Id of each meter that reads -> its noise, in standard deviations; empty where there is none."""
    if not scenario.telemetry.noise:
        return {}
    ids = [meter.id for meter in scenario.meters if meter.source is not Source.VIRTUAL]
    own = np.array([zlib.crc32(meter_id.encode()) for meter_id in ids], dtype=np.uint32)
    return dict(zip(ids, draw_noise([scenario.seed, scan], own).tolist(), strict=True))


def _read(scenario: Scenario, meter: Meter, exact: Mapping[str, float], noise: float) -> Measurement:
    """``exact``: see ``_read_exactly``; ``noise``: in standard deviations."""
    if meter.source is Source.VIRTUAL:
        return Measurement(meter, 0.0, 0.0)

    def read(meter: Meter) -> float:
        return exact[meter.id]

    sigma = scenario.sigma_rule.sigma(meter, read)
    sigmas_off = scenario.telemetry.gross_errors.get(meter.id, 0.0) + noise
    value = read(meter) + sigmas_off * sigma
    return Measurement(meter, max(value, 0.0) if meter.kind is MeasurementKind.CURRENT else value, sigma)
