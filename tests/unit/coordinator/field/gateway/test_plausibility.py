"""Right readings raise no suspicion; a wrong sign or unit of any one meter does, with its name."""

from __future__ import annotations

from dataclasses import replace

import pytest

from coordinator.field.gateway.plausibility import MISTAKES, Read, find_common_mistake, find_schedule, find_suspects
from dsse_core.grid.measurement import MeasurementKind
from dsse_core.power_flow.exact_readings import read_exactly
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import read_meters

SIGNIFICANT = 5.0  # sigma, and a part of the largest power: below, any sign may be right


@pytest.fixture(scope="module", params=["ieee33", "industrial13"])
def scenario(request: pytest.FixtureRequest) -> Scenario:
    return load_scenario(request.param)


@pytest.fixture(scope="module")
def reads(scenario: Scenario) -> dict[str, Read]:
    scan = read_meters(scenario)
    schedule = find_schedule(scenario.network, scenario.meters)
    found = zip(scenario.meters, scan.values.tolist(), scan.sigmas.tolist(), strict=True)
    return {meter.id: Read(value, sigma, schedule[meter.id]) for meter, value, sigma in found if sigma > 0}


def test_right_readings_raise_no_suspicion(scenario: Scenario, reads: dict[str, Read]) -> None:
    assert find_suspects(scenario.network, scenario.meters, reads) == ({}, [])


@pytest.mark.parametrize("load", [0.3, 0.5, 1.5, 2.0])
def test_another_days_load_raises_no_suspicion(scenario: Scenario, reads: dict[str, Read], load: float) -> None:
    network = scenario.network
    buses = tuple(replace(bus, p_load=load * bus.p_load, q_load=load * bus.q_load) for bus in network.buses)
    meters = [meter for meter in scenario.meters if meter.id in reads]
    exact, _ = read_exactly(solve_power_flow(replace(network, buses=buses)), meters)
    changed = {m.id: replace(reads[m.id], value=value) for m, value in zip(meters, exact.tolist(), strict=True)}
    suspects, unexplained = find_suspects(network, scenario.meters, changed)
    assert unexplained == []
    assert suspects == {}


@pytest.mark.parametrize("factor", MISTAKES)
def test_a_wrong_sign_or_unit_of_one_meter_is_named(scenario: Scenario, reads: dict[str, Read], factor: float) -> None:
    missed = []
    kinds = {meter.id: meter.kind for meter in scenario.meters}
    largest = max(abs(read.expected) for meter, read in reads.items() if kinds[meter] is not MeasurementKind.VM)
    for meter, read in reads.items():
        is_power = kinds[meter] is not MeasurementKind.VM
        if not is_power or abs(read.expected) < max(2 * SIGNIFICANT * read.sigma, 0.03 * largest):
            continue
        wrong = reads | {meter: replace(read, value=read.value / factor)}
        suspects, _ = find_suspects(scenario.network, scenario.meters, wrong)
        if not suspects.get(meter, "").startswith(MISTAKES[factor]):
            missed.append((meter, suspects))
    assert missed == []


@pytest.mark.parametrize("factor", MISTAKES)
def test_a_wrong_sign_or_unit_of_all_powers_is_named_where_all_balances_hold(
    scenario: Scenario, reads: dict[str, Read], factor: float
) -> None:
    powers = {meter.id for meter in scenario.meters if meter.kind is not MeasurementKind.VM}
    wrong = {m: replace(read, value=read.value / factor) if m in powers else read for m, read in reads.items()}
    assert find_common_mistake(scenario.network, scenario.meters, wrong) == MISTAKES[factor]
    assert find_common_mistake(scenario.network, scenario.meters, reads) == ""


@pytest.mark.parametrize(("factor", "hint"), [(3**-0.5, "line to neutral"), (1e3, "V in place of kV"), (0.5, "base")])
def test_a_voltage_off_its_base_is_named(scenario: Scenario, reads: dict[str, Read], factor: float, hint: str) -> None:
    wrong = reads | {"vm@1": replace(reads["vm@1"], value=factor)}
    suspects, _ = find_suspects(scenario.network, scenario.meters, wrong)
    assert hint in suspects.pop("vm@1")
    assert suspects == {}


def test_a_voltmeter_without_supply_is_no_matter_of_the_map(scenario: Scenario, reads: dict[str, Read]) -> None:
    wrong = reads | {"vm@1": replace(reads["vm@1"], value=0.0)}
    assert find_suspects(scenario.network, scenario.meters, wrong) == ({}, [])
