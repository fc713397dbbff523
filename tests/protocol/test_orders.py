"""What the operator's commands do to areas: a meter that is off has no part in the estimate, and all can see it."""

from __future__ import annotations

import numpy as np
import pytest

from agents.messages.packing import StateMessage
from agents.protocol.events import Ordered
from agents.protocol.quality import GOOD
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.measurement import Measurement, Source
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.simulated_bus import SimulatedBus, area_files_of

SCENARIO = load_scenario("ieee33")
TELEMETRY = make_telemetry(SCENARIO)
LIMIT = 1e-8  # p.u. and rad, as of every comparison of this strategy with the centre


def agreeing_bus() -> SimulatedBus:
    bus = SimulatedBus(area_files_of(SCENARIO, strategy="information"), TELEMETRY.by_area)
    settle(bus)
    return bus


def settle(bus: SimulatedBus) -> None:
    bus.run(1.0)
    bus.run_until_settled()
    bus.run(1.0)


def spared_meter(area: str) -> str:
    """A meter whose reading the estimate can do without, and which it uses."""
    state = agreeing_bus().states[area]
    own = [m.meter for m in TELEMETRY.by_area[area] if m.meter.source is not Source.VIRTUAL]
    return next(meter.id for meter in own if meter.id not in (*state.critical, *state.removed))


def find_gap(states: dict[str, StateMessage], *off: str) -> float:
    """The largest difference to the centralised estimate without the readings of the meters that are ``off``."""
    used: tuple[Measurement, ...] = tuple(m for m in TELEMETRY.union if m.meter.id not in off)
    central = process_bad_data(SCENARIO.network, used).result
    gaps = []
    for state in states.values():
        rows = [SCENARIO.network.row[bus] for bus in state.buses]
        gaps += [abs(np.array(state.vm) - central.vm[rows]).max(), abs(np.array(state.va) - central.va[rows]).max()]
    return float(max(gaps))


@pytest.mark.parametrize("area", ["area1", "area3"])
def test_a_meter_that_is_off_has_no_part_in_the_estimate_of_any_area(area: str):
    bus, meter = agreeing_bus(), spared_meter(area)
    scan = bus.states[area].header.scan
    assert find_gap(bus.states) < LIMIT < find_gap(bus.states, meter)
    bus.post(area, Ordered((5, 6, 1), (meter,)))
    settle(bus)
    state = bus.states[area]
    assert (state.meters_off, state.command, state.header.scan) == ((meter,), (5, 6, 1), scan)
    assert f"switched off by the operator: {meter}" in state.notes
    assert not any("no reading from" in note for note in state.notes)
    assert {s.quality for s in bus.states.values()} == {GOOD}
    assert find_gap(bus.states, meter) < LIMIT
    bus.post(area, Ordered((5, 6, 2), ()))
    settle(bus)
    assert bus.states[area].meters_off == ()
    assert not any("switched off" in note for note in bus.states[area].notes)
    assert find_gap(bus.states) < LIMIT


def test_a_meter_stays_off_in_the_scans_that_follow():
    bus, meter = agreeing_bus(), spared_meter("area2")
    bus.post("area2", Ordered((5, 6, 1), (meter,)))
    settle(bus)
    bus.next_scan(TELEMETRY.by_area)
    settle(bus)
    assert bus.states["area2"].header.scan == 2
    assert find_gap(bus.states, meter) < LIMIT


def test_a_meter_that_was_off_before_the_first_scan_is_not_used():
    bus = SimulatedBus(area_files_of(SCENARIO, strategy="information"), TELEMETRY.by_area)
    meter = spared_meter("area2")
    bus.post("area2", Ordered((5, 6, 1), (meter,)), delay_s=0.0)
    settle(bus)
    assert find_gap(bus.states, meter) < LIMIT


def test_a_scan_that_is_asked_for_begins_a_term_and_ends_with_the_same_readings():
    bus = agreeing_bus()
    before = {name: bus.protocols[name].term for name in bus.protocols}  # type: ignore[attr-defined]
    bus.post("area2", Ordered((5, 6, 1), (), scan=True))
    settle(bus)
    for name, protocol in bus.protocols.items():
        assert protocol.term > before[name]  # type: ignore[attr-defined]
    assert bus.states["area2"].command == (5, 6, 1)
    assert find_gap(bus.states) < LIMIT


@pytest.mark.parametrize("strategy", ["angle-offset", pytest.param("admm", marks=pytest.mark.long)])
def test_under_every_strategy_a_meter_that_is_off_is_not_used(strategy: str):
    files, meter = area_files_of(SCENARIO, strategy=strategy), spared_meter("area1")
    without = {name: [m for m in part if m.meter.id != meter] for name, part in TELEMETRY.by_area.items()}
    bus, other = SimulatedBus(files, TELEMETRY.by_area), SimulatedBus(files, without)
    bus.run(20.0)
    bus.post("area1", Ordered((5, 6, 1), (meter,)))
    bus.run(60.0)
    other.run(80.0)
    for name, state in bus.states.items():
        np.testing.assert_allclose(state.vm, other.states[name].vm, atol=1e-6)  # p.u., the tolerance of a scenario
    assert bus.states["area1"].meters_off == (meter,)
