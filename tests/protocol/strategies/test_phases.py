"""Areas of a network with phases over the simulated bus: the centre's estimate after loss, kills and restarts."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product

import pytest

from agents.messages.packing import Incarnation, LoadMessage, UpMessage, encode
from agents.protocol.choose import make_protocol
from agents.protocol.events import Ordered
from coordinator.lab.strategy_check import check_with_strategy
from dsse_core.errors import InvalidInputError
from dsse_core.estimation.bad_data import BadDataReport, process_bad_data
from dsse_core.estimation.state_limits import StateLimits
from dsse_core.exchange.gateway_mistakes import MISTAKES
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import Measurement
from dsse_core.grid.network import Network
from dsse_core.grid.partition import Partition
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.areas_with_phases import SOUND, find_gap, find_qualities, read_by_area, split_phases
from tests.support.levels import further
from tests.support.phases import AREAS, DEEP, RING, TIE, make_feeder, read_meters
from tests.support.scenario_with_phases import make_scenario
from tests.support.simulated_bus import SimulatedBus, area_files_of

GAP = 1e-9  # p.u. and rad
DIVISIONS = {"four areas": AREAS, "six areas": DEEP, "a ring": RING}


@cache
def divide(name: str) -> tuple[Network, Partition]:
    network = make_feeder(*([TIE] if name == "a ring" else []))
    return network, build_partition(network, DIVISIONS[name])


@cache
def estimate_centrally(name: str, *, is_rich: bool, seed: int = 2) -> tuple[list[Measurement], BadDataReport]:
    network, _ = divide(name)
    readings = read_meters(network, seed, 1.0, is_rich=is_rich)
    return readings, process_bad_data(network, readings)


def start(
    name: str, faults: LinkFaults = SOUND, *, is_rich: bool = True, strategy: str = "information"
) -> SimulatedBus:
    _, partition = divide(name)
    readings, _ = estimate_centrally(name, is_rich=is_rich)
    files = split_phases(partition, readings, faults, strategy=strategy)
    return SimulatedBus(files, read_by_area(partition, readings))


def assert_all_have_the_centres(bus: SimulatedBus, name: str, *, is_rich: bool = True) -> None:
    network, _ = divide(name)
    assert find_qualities(bus) == dict.fromkeys(bus.files, "good")
    assert find_gap(bus, network, estimate_centrally(name, is_rich=is_rich)[1]) < GAP


@pytest.mark.parametrize("name", DIVISIONS)
@pytest.mark.parametrize("is_rich", [True, *further(False)], ids=["rich", "sparse"])
def test_areas_with_phases_are_good_at_the_centres_estimate(name: str, is_rich: bool):
    bus = start(name, is_rich=is_rich)
    bus.run(3.0)
    assert_all_have_the_centres(bus, name, is_rich=is_rich)
    assert not any(state.rejected for state in bus.states.values())


def test_loss_of_most_messages_changes_no_estimate():
    bus = start("four areas", LinkFaults(loss=0.6))
    bus.run(20.0)
    assert_all_have_the_centres(bus, "four areas")


@pytest.mark.parametrize("gone", ["east", "head"])
def test_areas_without_a_killed_one_are_degraded_and_good_again_after_its_restart(gone: str):
    bus = start("four areas")
    bus.run(3.0)
    bus.kill(gone)
    bus.run(5.0)
    left = {name: quality for name, quality in find_qualities(bus).items() if name != gone}
    assert set(left.values()) == {"degraded"}
    assert find_gap(bus, divide("four areas")[0], estimate_centrally("four areas", is_rich=True)[1]) < 1e-3
    bus.start(gone)
    bus.run(5.0)
    assert_all_have_the_centres(bus, "four areas")


def test_messages_of_phases_are_as_small_as_their_variables_allow():
    bus = start("six areas")
    bus.run(3.0)
    largest: dict[int, int] = {}
    for _, _, _, message in bus.delivered:
        if isinstance(message, UpMessage):
            bare = encode(replace(message, no_load=(), totals=replace(message.totals, worst=(), tied=())))
            n = message.boundary.n_powers // 2
            largest[n] = max(largest.get(n, 0), len(bare))
    assert largest.keys() == {1, 2, 3}
    for n, most in ((1, 300), (2, 650), (3, 1100)):
        assert 250 < largest[n] <= most
    loads = {len(m.p): len(encode(m)) for _, _, _, m in bus.delivered if isinstance(m, LoadMessage)}
    assert loads.keys() == {1, 2, 3}


def test_a_strategy_of_one_voltage_a_bus_refuses_phases():
    expected = "buses have phases, which strategy 'angle-offset' cannot take: one offset turns .* 'information'"
    with pytest.raises(InvalidInputError, match=expected):
        check_with_strategy(make_scenario(strategy="angle-offset"))
    readings, _ = estimate_centrally("four areas", is_rich=True)
    content = split_phases(divide("four areas")[1], readings, strategy="angle-offset")[0]
    with pytest.raises(InvalidInputError, match=expected):
        make_protocol(content, Incarnation(1, 1), now=0.0, started_at=0.0)


@pytest.mark.parametrize("is_rich", [True, pytest.param(False, marks=pytest.mark.long)], ids=["rich", "sparse"])
def test_admm_agrees_on_the_centres_estimate_phase_by_phase(is_rich: bool):
    bus = start("four areas", is_rich=is_rich, strategy="admm")
    bus.run(5.0)
    assert find_qualities(bus) == dict.fromkeys(bus.files, "good")
    _, centre = estimate_centrally("four areas", is_rich=is_rich)
    assert find_gap(bus, divide("four areas")[0], centre) < 1e-8


def test_a_meter_of_a_phase_is_switched_off_by_the_operator():
    bus, off = start("four areas"), "vm@675.b"
    network, _ = divide("four areas")
    bus.run(3.0)
    bus.post("east", Ordered((5, 6, 1), (off,)))
    bus.run(3.0)
    readings, centre = estimate_centrally("four areas", is_rich=True)
    assert bus.states["east"].meters_off == (off,)
    assert f"switched off by the operator: {off}" in bus.states["east"].notes
    without = process_bad_data(network, [m for m in readings if m.meter.id != off])
    assert find_gap(bus, network, without) < GAP < find_gap(bus, network, centre)


def test_a_lie_about_voltages_of_a_boundary_is_named_with_its_phases():
    _, partition = divide("four areas")
    readings, _ = estimate_centrally("four areas", is_rich=True)
    files = [
        replace(f, links=f.links | ({"head": LinkFaults(lie_vm=0.01)} if f.area.name == "west" else {}))
        for f in split_phases(partition, readings)
    ]
    bus = SimulatedBus(files, read_by_area(partition, readings))
    bus.run(3.0)
    assert "good" not in find_qualities(bus).values()
    (note,) = (note for note in bus.states["head"].notes if note.startswith("boundary mismatch"))
    assert note.startswith("boundary mismatch with west at bus 671.ac: its final voltage differs by ")


@pytest.mark.parametrize(
    "faults",
    [LinkFaults(corrupt=0.2, duplicate=0.3), LinkFaults(delay_s=0.02, jitter_s=0.05, loss=0.2)],
    ids=["damaged and repeated", "late and overtaken"],
)
def test_faults_of_links_between_areas_with_phases_change_no_estimate(faults: LinkFaults):
    bus = start("six areas", faults)
    bus.run(15.0)
    assert_all_have_the_centres(bus, "six areas")


def test_an_estimate_outside_the_band_names_the_phase():
    _, partition = divide("four areas")
    readings, _ = estimate_centrally("four areas", is_rich=True)
    files = split_phases(partition, readings, limits=StateLimits(lowest_vm=1.01, highest_vm=1.5))
    bus = SimulatedBus(files, read_by_area(partition, readings))
    bus.run(3.0)
    (note,) = (note for note in bus.states["two"].notes if "are outside" in note)
    assert re.fullmatch(
        r"voltages of \d nodes are outside 1.01 to 1.5 p.u., the farthest is \S+ p.u. at bus \d+.[bc]", note
    )


def find_wrong_gateways(readings: Mapping[str, Sequence[Measurement]]) -> dict[str, str]:
    """Area of ieee13 -> its note on its gateway, in the first scan."""
    bus = SimulatedBus(area_files_of(load_scenario("ieee13")), readings)
    bus.run(1.0)
    assert len(bus.states) == 3
    return {name: note for name, state in bus.states.items() for note in state.notes if "look wrong" in note}


def test_no_sound_gateway_is_named_where_buses_have_phases():
    assert find_wrong_gateways(make_telemetry(load_scenario("ieee13")).by_area) == {}


WRONG_GATEWAYS = [("area1", -1.0), ("area2", 1e-3), ("area3", -1.0)]
OTHERS = [pair for pair in product(("area1", "area2", "area3"), (-1.0, 1e-3, 1e3)) if pair not in WRONG_GATEWAYS]


@pytest.mark.parametrize("wrong", [*WRONG_GATEWAYS, *further(*OTHERS)], ids=str)
def test_a_gateway_that_is_wrong_as_a_whole_is_named_where_buses_have_phases(wrong: tuple[str, float]):
    area, factor = wrong
    readings = dict(make_telemetry(load_scenario("ieee13")).by_area)
    readings[area] = [replace(m, value=factor * m.value) if m.meter.kind.of_power else m for m in readings[area]]
    found = find_wrong_gateways(readings)
    assert found.keys() == {area}
    assert MISTAKES[1 / factor] in found[area]


def test_a_bus_of_loads_between_phases_is_a_boundary_through_a_removal_and_restarts():
    """Areas 2 and 3 of ieee13 meet at bus 671; for the gross error all areas start anew without the voltmeter there."""
    scenario = load_scenario("ieee13", changes={"telemetry.gross_error": [{"meter": "vm@671.b", "sigmas": 40}]})
    telemetry = make_telemetry(scenario)
    centre = process_bad_data(scenario.network, telemetry.union)
    assert [removed.measurement.meter.id for removed in centre.removed] == ["vm@671.b"]
    bus = SimulatedBus(area_files_of(scenario), telemetry.by_area)
    bus.run(3.0)
    for gone in ("area3", "area2"):
        assert find_qualities(bus) == dict.fromkeys(bus.files, "good")
        assert bus.states["area2"].removed == ("vm@671.b",)
        assert find_gap(bus, scenario.network, centre) < GAP
        bus.kill(gone)
        bus.run(3.0)
        bus.start(gone)
        bus.run(3.0)
    assert find_gap(bus, scenario.network, centre) < GAP
