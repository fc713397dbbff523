"""Telemetry: the readings of every area in one scan, real ones or made from the truth, noise and gross errors."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dsse_core.errors import InvalidInputError
from dsse_core.exchange.boundary_load import boundary_loads, scheduled_load_messages
from dsse_core.grid.columns import Records, read_column, take_items
from dsse_core.grid.measurement import Measurement, Meter, Source
from dsse_core.grid.meter_table import KINDS, NO_BRANCH, QUANTITY, find_virtual, list_named_phases, number_kinds
from dsse_core.grid.network import Network
from dsse_core.grid.quantities import Quantity
from dsse_core.grid.switches import find_meters_in_service
from dsse_core.power_flow.exact_readings import read_exactly
from dsse_core.power_flow.newton_raphson import PowerFlowResult, solve_power_flow
from scenarios.crc32 import sum_up, write_bytes
from scenarios.meter_noise import draw_noise
from scenarios.scenario import Scenario

AS_STATED: Mapping[str, bool] = {}  # switches as the network has them


@dataclass(frozen=True, repr=False)
class Telemetry:
    """One scan. ``by_area``: area -> its measurements; ``union``: all of them, for the centralised WLS.

    ``truth`` is the power flow of the whole grid, None where the readings are real. ``area_power_flows``: power flow of
    each area, from which readings come under ``area-power-flow`` (angles refer to its local slack), else empty.
    """

    truth: PowerFlowResult | None
    by_area: Mapping[str, Sequence[Measurement]]
    union: Sequence[Measurement]
    area_power_flows: dict[str, PowerFlowResult]

    def __repr__(self) -> str:
        source = "real" if self.truth is None and not self.area_power_flows else "made from a power flow"
        return f"<Telemetry: {len(self.union)} readings in {len(self.by_area)} areas, {source}>"


@dataclass(frozen=True)
class Scan:
    """The readings of all meters of a scenario, in their order: ``values`` and ``sigmas`` in p.u. and rad, (n_meas,).

    ``missing``: positions of the meters whose readings the scan lacks. ``truth``, ``area_power_flows``: see Telemetry.
    """

    values: np.ndarray
    sigmas: np.ndarray
    missing: list[int]
    truth: PowerFlowResult | None
    area_power_flows: dict[str, PowerFlowResult]


def make_telemetry(scenario: Scenario, scan: int = 1, closed: Mapping[str, bool] = AS_STATED) -> Telemetry:
    """Readings of all meters in scan number ``scan``, each a measurement. Raises as ``read_meters``."""
    read = read_meters(scenario, scan, closed)
    union = Records(Measurement, {"meter": scenario.meters, "value": read.values, "sigma": read.sigmas})
    if read.missing:
        union = union.take(np.delete(np.arange(len(union)), read.missing))
    positions = scenario.partition.split_meters(union.columns["meter"])
    return Telemetry(
        read.truth, {area: union.take(own) for area, own in positions.items()}, union, read.area_power_flows
    )


def expect_telemetry(scenario: Scenario) -> Telemetry:
    """Telemetry known before a run: that of its first scan, no readings where gateways will send them."""
    if scenario.telemetry.source == "live":
        return Telemetry(None, {area.name: () for area in scenario.partition.areas}, (), {})
    return make_telemetry(scenario)


def read_meters(scenario: Scenario, scan: int = 1, closed: Mapping[str, bool] = AS_STATED) -> Scan:
    """Readings of all meters in scan number ``scan``: the same for the same scenario, seed and scan.

    A meter's noise depends on seed, scan and its own id only, not on which other meters there are.

    ``closed``: switch -> its true status, where it is not that of the network. Exact readings are 0 at open branches
    and where there is no supply.

    Raises:
        InvalidInputError: ``area-power-flow`` and an area without local slack voltage; or source ``live``.
        PowerFlowDivergedError: the grid, or an area by itself, has no power flow solution.
    """
    truth, area_power_flows = None, {}
    if scenario.telemetry.source == "live":
        problem = "telemetry.source is 'live': its readings come from gateways while it runs, and none can be made here"
        raise InvalidInputError(f"scenario {scenario.name!r}", [problem])
    if scenario.telemetry.source == "file":
        values, sigmas = _real_readings(scenario)
    else:
        truth = solve_with_supply(scenario.network.operated(closed))
        if scenario.telemetry.source == "area-power-flow":
            area_power_flows = _solve_area_power_flows(scenario)
            by_meter = {m: s for part in _read_by_area(scenario, area_power_flows) for m, *s in zip(*part, strict=True)}
            exact, size = np.array([by_meter[m] for m in scenario.meters], dtype=float).reshape(-1, 2).T
        else:
            exact, size = read_in_service(truth, scenario.meters)
        values, sigmas = _read(scenario, scan, exact, size)
    missing = []
    if scenario.faults.telemetry.missing > 0:
        missing = [k for k, meter in enumerate(scenario.meters) if _is_missing(scenario, scan, meter)]
    return Scan(values, sigmas, missing, truth, area_power_flows)


def solve_with_supply(network: Network) -> PowerFlowResult:
    """The power flow of the part of ``network`` that has supply; 0 elsewhere."""
    return solve_power_flow(network.supplied())


def read_in_service(truth: PowerFlowResult, meters: Sequence[Meter]) -> tuple[np.ndarray, np.ndarray]:
    """Readings and sizes of ``read_exactly``, 0 at open branches; the size of a voltage is 1 p.u. without supply."""
    rows = find_meters_in_service(truth.network, meters)
    if len(rows) == len(meters):
        exact, size = read_exactly(truth, meters)
    else:
        exact, size = np.zeros(len(meters)), np.zeros(len(meters))
        exact[rows], size[rows] = read_exactly(truth, take_items(meters, rows))
    if not truth.vm.all():
        size[(QUANTITY[number_kinds(meters)] == Quantity.VM) & (size == 0)] = 1.0
    return exact, size


def find_lateness(scenario: Scenario, scan: int) -> dict[str, float]:
    """Area -> lateness of the readings of ``scan`` there, s, by the faults of telemetry; areas without are left out."""
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
    """Areas that ``area-power-flow`` cannot solve by themselves, as problems with the keys to add."""
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
    """The meters of each area, and their exact values and sizes by ``read_exactly`` in its own power flow."""
    for name, meters in scenario.partition.meters_by_area(scenario.meters).items():
        yield (meters, *read_exactly(power_flows[name], meters))


def _real_readings(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Values and standard deviations from the file, with gross errors; 0 of virtual meters."""
    gross, readings, real = scenario.telemetry.gross_errors, scenario.telemetry.readings, ~find_virtual(scenario.meters)
    values, sigmas = np.zeros(len(scenario.meters)), np.zeros(len(scenario.meters))
    values[real], sigmas[real] = (read_column(readings, name, float) for name in ("value", "sigma"))
    if gross:
        values += np.array([gross.get(meter.id, 0.0) for meter in scenario.meters]) * sigmas
    return values, sigmas


def _read(scenario: Scenario, scan: int, exact: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and standard deviations, shape (n_meas,) each; ``exact``, ``size``: see ``read_exactly``."""
    meters = scenario.meters
    sigma = scenario.sigma_rule.sigmas(meters, size)
    sigmas_off = _draw_noise(scenario, scan)
    if gross := scenario.telemetry.gross_errors:
        sigmas_off += np.array([gross.get(meter.id, 0.0) for meter in meters])
    values = exact + sigmas_off * sigma
    values[(QUANTITY[number_kinds(meters)] == Quantity.CURRENT) & (values < 0)] = 0.0
    values[find_virtual(meters)] = 0.0
    return values, sigma


def _draw_noise(scenario: Scenario, scan: int) -> np.ndarray:
    """The noise of all meters, in standard deviations, shape (n_meas,)."""
    if not scenario.telemetry.noise:
        return np.zeros(len(scenario.meters))
    return draw_noise([scenario.seed, scan], sum_up_ids(scenario.network, scenario.meters))


def sum_up_ids(network: Network, meters: Sequence[Meter]) -> np.ndarray:
    """The CRC-32 of the id of each of ``meters``, (n_meas,), uint32."""
    if not isinstance(meters, Records):
        return np.array([zlib.crc32(meter.id.encode()) for meter in meters], dtype=np.uint32)
    columns, ids = meters.columns, write_bytes([branch.encode() for branch in network.branch_ids])
    own = np.zeros(len(meters), dtype=np.uint32)
    phases = None
    if "phase" in columns:
        phases = write_bytes([f".{named}".rstrip(".").encode() for named in list_named_phases(meters)])
    of_branch = columns["branch"] != NO_BRANCH
    for k, kind in enumerate(KINDS):
        of_kind = columns["kind"] == k
        for at_branch in (False, True):
            here = np.flatnonzero(of_kind & (of_branch == at_branch))
            begun = np.full(len(here), zlib.crc32(f"{kind}@".encode()), dtype=np.uint32)
            sums = sum_up(begun, write_bytes(columns["bus"][here].astype(np.bytes_)))
            if phases is not None:
                sums = sum_up(sums, phases.of(here))
            if at_branch:
                sums = sum_up(sum_up(sums, write_bytes([b":"] * len(here))), ids.of(columns["branch"][here]))
            own[here] = sums
    return own
