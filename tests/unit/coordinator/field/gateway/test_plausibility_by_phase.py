"""Signs and units of meters of phases: right readings raise no suspicion; a wrong meter is named, with its phase."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from coordinator.field.gateway.plausibility import (
    MISTAKES,
    Read,
    find_balances,
    find_common_mistake,
    find_schedule,
    find_suspects,
)
from dsse_core.grid.measurement import MeasurementKind, Meter
from dsse_core.power_flow.exact_readings import read_exactly
from dsse_core.power_flow.newton_raphson import solve_power_flow
from scenarios.scenario import load_scenario
from scenarios.telemetry import read_meters
from tests.support.ieee_feeders import load_feeder

EVERYWHERE = {"measurements.flow.branches": list(load_scenario("ieee13").network.branch_ids)}
SCENARIO = load_scenario("ieee13", changes=EVERYWHERE)
NETWORK, METERS = SCENARIO.network, SCENARIO.meters
KINDS = {meter.id: meter.kind for meter in METERS}
VM = MeasurementKind.VM


@pytest.fixture(scope="module")
def reads() -> dict[str, Read]:
    scan, schedule = read_meters(SCENARIO), find_schedule(NETWORK, METERS)
    found = zip(METERS, scan.values.tolist(), scan.sigmas.tolist(), strict=True)
    return {meter.id: Read(value, sigma, schedule[meter.id]) for meter, value, sigma in found if sigma > 0}


def test_right_readings_raise_no_suspicion_and_nodes_balance_phase_by_phase(reads: dict[str, Read]) -> None:
    assert find_suspects(NETWORK, METERS, reads) == ({}, [])
    assert find_common_mistake(NETWORK, METERS, reads) == ""
    places = {balance.place for balance in find_balances(NETWORK, METERS, reads)}
    assert {"bus 632.a (P)", "bus 632.b (P)", "bus 632.c (Q)", "bus 645.b (Q)", "bus 611.c (P)"} <= places
    assert not any("646" in place for place in places)  # its load stands between two phases


LEVELS: list[Callable[[np.random.Generator], float]] = [
    *(lambda _, level=level: level for level in (0.5, 1.5, 2.0)),  # type: ignore[misc]
    *[lambda rng: rng.uniform(0.4, 1.8)] * 3,
]


@pytest.mark.parametrize("k", range(len(LEVELS)))
def test_another_days_load_of_each_leg_raises_no_suspicion(reads: dict[str, Read], k: int) -> None:
    rng = np.random.default_rng(k)
    loads = tuple(replace(load, s=LEVELS[k](rng) * load.s) for load in NETWORK.loads)
    meters = [meter for meter in METERS if meter.id in reads]
    exact, _ = read_exactly(solve_power_flow(replace(NETWORK, loads=loads)), meters)
    changed = {m.id: replace(reads[m.id], value=value) for m, value in zip(meters, exact.tolist(), strict=True)}
    assert find_suspects(NETWORK, METERS, changed) == ({}, [])


@pytest.mark.parametrize("factor", MISTAKES)
def test_a_wrong_sign_or_unit_of_one_phase_is_named_and_of_no_other(reads: dict[str, Read], factor: float) -> None:
    missed, tried = [], 0
    largest = max(abs(read.expected) for meter, read in reads.items() if KINDS[meter] is not VM)
    for meter, read in reads.items():
        if KINDS[meter] is VM or abs(read.expected) < max(10.0 * read.sigma, 0.03 * largest):
            continue
        tried += 1
        wrong = reads | {meter: replace(read, value=read.value / factor)}
        suspects, unexplained = find_suspects(NETWORK, METERS, wrong)
        if suspects.keys() != {meter} or not suspects[meter].startswith(MISTAKES[factor]) or unexplained:
            missed.append((meter, suspects, unexplained))
    assert missed == []
    assert tried > 50


@pytest.mark.parametrize("factor", MISTAKES)
def test_a_wrong_sign_or_unit_of_all_powers_is_named(reads: dict[str, Read], factor: float) -> None:
    wrong = {m: read if KINDS[m] is VM else replace(read, value=read.value / factor) for m, read in reads.items()}
    assert find_common_mistake(NETWORK, METERS, wrong) == MISTAKES[factor]


@pytest.mark.parametrize(
    ("factor", "hint"), [(3**0.5, "line to line"), (3**-0.5, "line to neutral"), (1e3, "V in place of kV"), (0.5, "")]
)
def test_a_voltage_of_a_phase_off_its_base_is_named(reads: dict[str, Read], factor: float, hint: str) -> None:
    read = reads["vm@671.b"]
    suspects, _ = find_suspects(NETWORK, METERS, reads | {"vm@671.b": replace(read, value=factor * read.value)})
    assert hint in suspects.pop("vm@671.b")
    assert suspects == {}


def test_powers_of_a_phase_do_not_balance_across_a_bank_between_delta_and_wye() -> None:
    network = load_feeder("4bus-dy")
    meters = [
        Meter(MeasurementKind.P_FLOW, end, branch.id, phases=phase)
        for branch in network.branches
        for end in (branch.from_bus, branch.to_bus)
        for phase in "abc"
    ]
    places = {balance.place for balance in find_balances(network, meters, [meter.id for meter in meters])}
    banks = [b.id for b in network.branches if b.primitive and not b.primitive.is_straight]
    lines = [b.id for b in network.branches if b.primitive and b.primitive.is_straight]
    assert banks
    assert {f"branch {line}.{phase} (P)" for line in lines for phase in "abc"} <= places
    assert not any(bank in place for bank in banks for place in places)
