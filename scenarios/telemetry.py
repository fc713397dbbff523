"""Telemetry: what the meters of every area read in one scan, made from the truth, noise and gross errors, or real."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.exchange.boundary_load import boundary_loads, scheduled_load_messages
from dsse_core.grid.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.power_flow.newton_raphson import PowerFlowResult, solve_power_flow
from scenarios.meter_noise import draw_noise
from scenarios.meters import OTHER_POWER
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
    truth, area_power_flows = None, {}
    if scenario.telemetry.source == "file":
        union = tuple(_real_reading(scenario, meter) for meter in scenario.meters)
    else:
        truth = solve_power_flow(scenario.network)
        if scenario.telemetry.source == "area-power-flow":
            area_power_flows = _solve_area_power_flows(scenario)
            by_meter = {m: s for part in _read_by_area(scenario, area_power_flows) for m, *s in zip(*part, strict=True)}
            exact, size = np.array([by_meter[m] for m in scenario.meters], dtype=float).reshape(-1, 2).T
        else:
            exact, size = _read_exactly(truth, scenario.meters)
        union = _read(scenario, scan, exact, size)
    if scenario.faults.telemetry.missing > 0:
        union = tuple(m for m in union if not _is_missing(scenario, scan, m.meter))
    by_area: dict[str, list[Measurement]] = {area.name: [] for area in scenario.partition.areas}
    for measurement in union:
        by_area[scenario.partition.area_of_meter(measurement.meter)].append(measurement)
    return Telemetry(truth, {name: tuple(part) for name, part in by_area.items()}, union, area_power_flows)


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
    received = scheduled_load_messages(scenario.partition)
    results = {}
    for area in scenario.partition.areas:
        assert area.slack_vm is not None  # find_missing_local_slacks
        loads = boundary_loads(area, received[area.name], scenario.load_error[area.name])
        results[area.name] = solve_power_flow(
            area.network,
            slack=(area.slack_bus, area.slack_vm),
            extra_load={bus: load.s for bus, load in loads.items()},
        )
    return results


def _read_by_area(
    scenario: Scenario, power_flows: Mapping[str, PowerFlowResult]
) -> Iterator[tuple[Sequence[Meter], np.ndarray, np.ndarray]]:
    """The meters of each area and what ``_read_exactly`` finds for them in its own power flow."""
    for name, meters in scenario.partition.meters_by_area(scenario.meters).items():
        yield (meters, *_read_exactly(power_flows[name], meters))


def _read_exactly(power_flow: PowerFlowResult, meters: Sequence[Meter]) -> tuple[np.ndarray, np.ndarray]:
    """What each meter would read without error, and its size: of a power the apparent one, shape (n_meas,) each."""
    places = {(m.kind, m.bus, m.branch): k for k, m in enumerate(meters)}
    also: list[Meter] = []
    partner = np.arange(len(meters))
    for k, m in enumerate(meters):
        if (kind := OTHER_POWER.get(m.kind)) is not None:
            partner[k] = places.setdefault((kind, m.bus, m.branch), len(places))
            if partner[k] == len(meters) + len(also):
                also.append(Meter(kind, m.bus, m.branch))
    read = power_flow.read_all([*meters, *also])
    exact = read[: len(meters)]
    return exact, np.where(partner == np.arange(len(meters)), abs(exact), np.hypot(exact, read[partner]))


def _real_reading(scenario: Scenario, meter: Meter) -> Measurement:
    if meter.source is Source.VIRTUAL:
        return Measurement(meter, 0.0, 0.0)
    real = scenario.telemetry.readings[meter.id]
    return replace(real, value=real.value + scenario.telemetry.gross_errors.get(meter.id, 0.0) * real.sigma)


def _read(scenario: Scenario, scan: int, exact: np.ndarray, size: np.ndarray) -> tuple[Measurement, ...]:
    """``exact``, ``size``: see ``_read_exactly``."""
    meters = scenario.meters
    ids = [meter.id for meter in meters]
    sigma = scenario.sigma_rule.sigmas(meters, size)
    gross = scenario.telemetry.gross_errors
    sigmas_off = np.array([gross.get(i, 0.0) for i in ids]) + _draw_noise(scenario, scan, ids)
    values = np.array(exact + sigmas_off * sigma)
    values[[m.kind is MeasurementKind.CURRENT for m in meters] & (values < 0)] = 0.0
    values[[m.source is Source.VIRTUAL for m in meters]] = 0.0
    return tuple(map(Measurement, meters, values.tolist(), sigma.tolist()))


def _draw_noise(scenario: Scenario, scan: int, ids: Sequence[str]) -> np.ndarray:
    """The noise of the meters called ``ids``, in standard deviations, shape (n_meas,)."""
    if not scenario.telemetry.noise:
        return np.zeros(len(ids))
    own = np.array([zlib.crc32(meter_id.encode()) for meter_id in ids], dtype=np.uint32)
    return draw_noise([scenario.seed, scan], own)
