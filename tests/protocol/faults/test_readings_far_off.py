"""Readings of one area, all wrong by a factor: few rounds, one term, and the reason of the centralised estimate."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agents.messages.packing import DownMessage, UpMessage
from dsse_core.errors import EstimationDivergedError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.estimation.decision import MOST_STEPS
from dsse_core.grid.measurement import Measurement, MeasurementKind, Source
from scenarios.scenario import Scenario, load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.levels import further
from tests.support.simulated_bus import SimulatedBus, area_files_of

MOST_ROUNDS = 30


def read_wrongly(scenario: Scenario, area: str, factor: float, *, with_vm: bool) -> dict[str, list[Measurement]]:
    """Area -> its readings; those of ``area`` are multiplied by ``factor``."""

    def is_wrong(m: Measurement) -> bool:
        return m.meter.source is not Source.VIRTUAL and (with_vm or m.meter.kind is not MeasurementKind.VM)

    readings = {name: list(of_area) for name, of_area in make_telemetry(scenario).by_area.items()}
    readings[area] = [replace(m, value=factor * m.value) if is_wrong(m) else m for m in readings[area]]
    return readings


def rounds_of(bus: SimulatedBus) -> set[tuple[int, int]]:
    """(revision, k) of all rounds."""
    return {(m.revision, m.k) for *_, m in bus.delivered if isinstance(m, UpMessage | DownMessage)}


def end_of_centre(scenario: Scenario, readings: dict[str, list[Measurement]]) -> str:
    try:
        report = process_bad_data(scenario.network, [m for of_area in readings.values() for m in of_area])
    except EstimationDivergedError as error:
        return error.reason
    return report.suspect.reason if report.suspect else ""


@pytest.mark.parametrize("factor", [1000.0, *further(100.0)])
@pytest.mark.parametrize(("name", "area"), [("ieee33", "area1"), ("ieee33", "area3"), ("industrial13", "area2")])
def test_readings_of_an_area_times_a_thousand_cost_few_rounds_and_name_the_reason(name: str, area: str, factor: float):
    scenario = load_scenario(name)
    readings = read_wrongly(scenario, area, factor, with_vm=True)
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), readings)
    bus.run(2.0)
    assert len(rounds_of(bus)) <= MOST_ROUNDS
    assert {revision for revision, _ in rounds_of(bus)} == {0}
    assert end_of_centre(scenario, readings) == "out of reach"
    offs = {}
    for state in bus.states.values():
        (note,) = [note for note in state.notes if "the iteration has not converged (out of reach)" in note]
        offs[state.header.sender] = float(note.split("are ")[1].split()[0])
        assert state.rejected == {}
    assert max(offs, key=offs.get) == area


@pytest.mark.parametrize(("area", "factor"), [("area1", 10.0), ("area2", 1000.0)])
def test_the_steps_of_a_scan_are_limited_over_all_its_starts(area: str, factor: float):
    scenario = load_scenario("industrial13")
    readings = read_wrongly(scenario, area, factor, with_vm=factor < 100)
    bus = SimulatedBus(area_files_of(scenario, strategy="information"), readings)
    bus.run(8.0)
    rounds = rounds_of(bus)
    assert {revision for revision, _ in rounds} == {0}
    assert len(rounds) < 2 * 6 * MOST_STEPS  # a step and its shortening, of four starts and the last two
    reason = end_of_centre(scenario, readings)
    assert all(any(reason in note for note in state.notes) for state in bus.states.values()), reason
