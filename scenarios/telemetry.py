"""Telemetry: what the meters of every area read in one scan, made from the truth, noise and gross errors."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dsse_core.boundary_load import boundary_loads, scheduled_load_messages
from dsse_core.errors import InvalidInputError
from dsse_core.measurement import Measurement, MeasurementKind, Meter, Source
from dsse_core.power_flow import PowerFlowResult, solve_power_flow
from scenarios.scenario import Scenario


@dataclass(frozen=True)
class Telemetry:
    """One scan. ``by_area``: area -> its measurements; ``union``: all of them, for the centralised WLS.

    ``truth`` is the power flow of the whole grid, ``area_power_flows`` those that the readings come from under
    ``area-power-flow`` (their angles refer to each area's local slack), else empty.
    """

    truth: PowerFlowResult
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
    truth = solve_power_flow(scenario.network)
    area_power_flows = _solve_area_power_flows(scenario) if scenario.telemetry.source == "area-power-flow" else {}
    area_of = {meter.id: scenario.partition.area_of_meter(meter) for meter in scenario.meters}
    union = tuple(
        _read(scenario, scan, meter, area_power_flows.get(area_of[meter.id], truth).read) for meter in scenario.meters
    )
    by_area = {
        area.name: tuple(m for m in union if area_of[m.meter.id] == area.name) for area in scenario.partition.areas
    }
    return Telemetry(truth, by_area, union, area_power_flows)


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


def _read(scenario: Scenario, scan: int, meter: Meter, read: Callable[[Meter], float]) -> Measurement:
    if meter.source is Source.VIRTUAL:
        return Measurement(meter, 0.0, 0.0)
    sigma = scenario.sigma_rule.sigma(meter, read)
    sigmas_off = scenario.telemetry.gross_errors.get(meter.id, 0.0)
    if scenario.telemetry.noise:
        sigmas_off += np.random.default_rng([scenario.seed, scan, zlib.crc32(meter.id.encode())]).standard_normal()
    value = read(meter) + sigmas_off * sigma
    return Measurement(meter, max(value, 0.0) if meter.kind is MeasurementKind.CURRENT else value, sigma)
