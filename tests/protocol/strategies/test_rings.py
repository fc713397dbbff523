"""Two areas that meet at several buses: a ring passes through both, and the areas still end where the centre does."""

from dataclasses import replace

import numpy as np
import pytest

from agents.area_files.area_file import save_area_file
from agents.area_files.reader import load_area_file
from agents.messages.packing import Incarnation, UpMessage
from agents.protocol.choose import make_protocol
from coordinator.lab.strategy_check import check_with_strategy
from dsse_core.errors import EstimationDivergedError, InvalidInputError, NotObservableError, PowerFlowDivergedError
from dsse_core.estimation.bad_data import process_bad_data
from dsse_core.grid.measurement import MeasurementKind
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support import areas_with_phases
from tests.support.areas_with_phases import find_qualities
from tests.support.exact_exchange import (
    assert_equals_centralised,
    assert_same_decisions,
    run_feeder,
    settle,
    settle_bus,
)
from tests.support.feeders import Feeder
from tests.support.grids import with_gross_errors
from tests.support.levels import further
from tests.support.rings import ACROSS, TIES, make_ring_feeder, ring33, tied13, tied33
from tests.support.simulated_bus import SimulatedBus, area_files_of, with_links

GAP = 1e-9  # p.u. and rad


def settle_ring33(loss: float = 0.0):
    """The simulated bus at rest, and the centralised estimate."""
    scenario = ring33()
    telemetry = make_telemetry(scenario)
    files = with_links(area_files_of(scenario, strategy="information"), LinkFaults(loss=loss))
    bus = SimulatedBus(files, telemetry.by_area)
    settle_bus(bus)
    return bus, process_bad_data(scenario.network, telemetry.union, tolerance=1e-12), telemetry


def find_gap(bus, report, names=None):
    """The largest distance of a voltage from the centralised estimate, p.u."""
    result = report.result
    central = result.vm * np.exp(1j * result.va)
    row = result.network.row
    states = [state for name, state in bus.states.items() if names is None or name in names]
    return max(
        abs(vm * np.exp(1j * va) - central[row[bus_id]])
        for state in states
        for bus_id, vm, va in zip(state.buses, state.vm, state.va, strict=True)
    )


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_two_feeders_joined_at_two_buses_end_at_the_centralised_estimate(loss):
    bus, report, _ = settle_ring33(loss)
    assert {state.quality for state in bus.states.values()} == {"good"}
    assert find_gap(bus, report) < GAP
    assert_equals_centralised(bus, report)
    assert_same_decisions(bus, report)
    names = {message.variables for *_, message in bus.delivered if isinstance(message, UpMessage)}
    assert names == {("s@6>lateral", "s@18>lateral", "v@6", "v@18")}


OTHERS = [(3, TIES, (), 0.3), (8, TIES, (), 0.3), (5, (), (), 0.0), (8, TIES[:2], (), 0.0), (8, TIES, ACROSS, 0.0)]


@pytest.mark.parametrize("case", [(5, TIES, (), 0.3), (5, TIES, ACROSS, 0.3), *further(*OTHERS)])
def test_ties_that_are_carried_open_or_closed_leave_all_variables_where_they_are(case):
    """Five rings through all areas, or none; with a branch of each ring opened, sections are fed from another side."""
    n_area, closed, opened, loss = case
    scenario = tied33(n_area, closed, opened)
    carried = {area.name: area.boundaries for area in scenario.partition.areas}
    assert carried == {area.name: area.boundaries for area in tied33(n_area, ()).partition.areas}
    bus, report = settle(scenario, loss)
    bus.run(2.0)
    assert {state.quality for state in bus.states.values()} == {"good"}
    assert find_gap(bus, report) < GAP
    assert_equals_centralised(bus, report)
    assert_same_decisions(bus, report)


@pytest.mark.long
@pytest.mark.parametrize(("n_area", "victim"), [(5, "area1"), (5, "area3"), (8, "area4")])
def test_an_area_that_dies_in_rings_leaves_the_others_within_their_standard_deviations_and_none_good(n_area, victim):
    scenario = tied33(n_area)
    bus, report = settle(scenario, 0.3)
    bus.kill(victim)
    bus.next_scan(make_telemetry(scenario).by_area)
    bus.run(20.0)
    row = report.result.network.row
    for name in bus.states.keys() - {victim}:
        state = bus.states[name]
        off = abs(np.array(state.vm) - report.result.vm[[row[bus_id] for bus_id in state.buses]])
        assert (off / state.sigma_vm).max() < 5
        assert state.quality in {"degraded", "relative-angle"}
    bus.start(victim)
    bus.run(20.0)
    assert {state.quality for state in bus.states.values()} == {"good"}
    assert find_gap(bus, report) < GAP


@pytest.mark.parametrize("closed", [("645-611", "633-680"), *further((), ("645-611",), ("633-680",))])
def test_phases_of_ties_are_carried_each_by_itself(closed, tmp_path):
    """Area 2 relays phase c of bus 611 between areas 1 and 3."""
    scenario = tied13(closed)
    area2 = scenario.partition.area("area2")
    assert area2.boundaries["area3"].names == ("s@611.c>area1", "s@671.ac>area3", "v@611.c", "v@671.ac")
    assert (area2.relayed, area2.network.bus(611).phases) == ({611}, "c")
    for content in area_files_of(scenario):
        save_area_file(path := tmp_path / "area.json", content)
        assert load_area_file(path) == content
    bus, report = settle(scenario)
    assert find_qualities(bus) == dict.fromkeys(bus.files, "good")
    assert areas_with_phases.find_gap(bus, scenario.network, report) < GAP
    assert_same_decisions(bus, report)


LISTED = {  # no bus twice; the branches between areas
    "ieee13": (
        [[1, 2, 60, 632, 633, 634, 645, 646, 650], [670, 671, 675, 680], [611, 652, 684]],
        ("632-670", "671-684"),
    ),
    "ieee33": ([[*range(1, 7), *range(19, 26)], [*range(7, 19)], [*range(26, 34)]], ("6-7", "6-26")),
}
UPPER = {"ieee13": ("area1", "area2"), "ieee33": ("area1", "area1")}  # the areas at their from buses
LOWER = {"ieee13": ("area2", "area3"), "ieee33": ("area2", "area3")}
SIDES = [(name, side) for name in LISTED for side in (UPPER, LOWER)]


@pytest.mark.long
@pytest.mark.parametrize("case", SIDES)
def test_currents_between_areas_are_held_by_either_side(case, tmp_path):
    """The meter stands at the bus of the upper area; bus 671 has loads between phases."""
    name, side = case
    buses, between = LISTED[name]
    held = dict(zip(between, side[name], strict=True))
    areas = {f"area{k}": [b for b in between if held[b] == f"area{k}"] for k in (1, 2, 3)}
    text = [f'version = 1\ndescription = "three areas"\nnetwork = "{name}"']
    text += [f"[areas.{a}]\nbuses = {own}\nholds = {ids}" for own, (a, ids) in zip(buses, areas.items(), strict=True)]
    text += [
        '[measurements]\nfloor_kva = 1.0\nzero_injection = "virtual"',
        f"voltage = {{ buses = {buses[1]}, sigma_percent = 0.5 }}",
        f"current = {{ branches = {list(between)}, sigma_percent = 1.0 }}",
        'injection = { buses = "all", sigma_percent = 10.0 }\n[telemetry]\nnoise = true',
    ]
    (path := tmp_path / "scenario.toml").write_text("\n".join(text))
    scenario = load_scenario(path)
    currents = [m for m in scenario.meters if m.kind is MeasurementKind.CURRENT]
    assert {m.branch: scenario.partition.area_of_meter(m) for m in currents} == held
    bus, report = settle(scenario)
    assert {state.quality for state in bus.states.values()} == {"good"}
    assert areas_with_phases.find_gap(bus, scenario.network, report) < GAP
    assert_same_decisions(bus, report)


def draw_ring(random_seed: int, **changes) -> Feeder:
    try:
        feeder = make_ring_feeder(random_seed, 2 + random_seed % 5, 1 + random_seed % 3, **changes)
    except PowerFlowDivergedError:
        feeder = None
    return feeder or pytest.skip("no ring in this draw")


@pytest.mark.random_cases(few=3, long=3, many=90)
def test_any_ring_between_an_area_and_its_parent_reaches_it(random_seed):
    feeder = draw_ring(random_seed, decades=float(random_seed % 4))
    if random_seed % 2:
        feeder = with_gross_errors(np.random.default_rng(random_seed), feeder)
    try:
        process_bad_data(feeder.network, feeder.measurements)
    except (EstimationDivergedError, NotObservableError):
        pytest.skip("the centre has no estimate")
    bus, report = run_feeder(feeder, 0.3 * (random_seed % 3 == 0), 0)
    assert find_gap(bus, report) < GAP
    assert_equals_centralised(bus, report)
    assert_same_decisions(bus, report)


@pytest.mark.random_cases(few=2, long=2, many=60)
def test_buses_that_nothing_determines_are_named_as_in_the_centre_also_around_a_ring(random_seed):
    assert_same_unobservable(random_seed)


def test_a_step_of_what_is_not_observable_may_lead_beyond_reason_and_still_all_areas_come_to_the_end():
    """J beyond 1e18 in the totals, which every area rejects."""
    bus = assert_same_unobservable(7)
    assert {state.quality for state in bus.states.values()} == {"unobservable"}
    assert all(not state.rejected for state in bus.states.values())


def assert_same_unobservable(random_seed: int) -> SimulatedBus:
    """That areas name the buses that the centre names, where a fifth of the readings are lost."""
    feeder, rng = draw_ring(random_seed), np.random.default_rng(random_seed)
    lost = set(rng.choice(len(feeder.measurements), len(feeder.measurements) // 5, replace=False).tolist())
    feeder = replace(feeder, measurements=tuple(m for k, m in enumerate(feeder.measurements) if k not in lost))
    try:
        process_bad_data(feeder.network, feeder.measurements)
    except EstimationDivergedError:
        pytest.skip("the centre has no estimate")
    except NotObservableError as error:
        expected = set(error.buses)
    else:
        expected = set()
    bus = SimulatedBus(feeder.area_files(0.0, 0), feeder.telemetry())
    bus.run(5.0)
    found = set()
    for protocol in bus.protocols.values():
        for name in protocol.outcome.totals.unobservable:
            first, _, last = name.partition("-")
            found |= set(range(int(first), int(last or first) + 1))
    assert found == expected
    return bus


def scheduled_loads(files):
    return [load for content in files for load in content.area.scheduled_loads.values()]


def test_an_area_alone_in_its_ring_says_so_and_stays_near_what_it_was():
    """A net load has no side in a ring: each voltage and each power stands in as it was."""
    bus, report, telemetry = settle_ring33()
    estimation = bus.protocols["main"].round.estimation
    as_it_was = np.array(estimation.boundary_values("lateral"))
    bus.kill("lateral")
    bus.next_scan(telemetry.by_area)
    bus.run(20.0)
    assert bus.states["main"].quality == "degraded"
    stand_in = estimation.stand_ins["lateral"]
    np.testing.assert_allclose(np.linalg.solve(stand_in.R, stand_in.z), as_it_was, atol=1e-9)
    np.testing.assert_allclose(np.diag(stand_in.R)[4:], 20.0)
    all_load = sum(map(abs, scheduled_loads(bus.files.values())))
    assert np.diag(stand_in.R)[:4].max() < 2 / all_load
    assert find_gap(bus, report, ["main"]) < 0.01
    bus.start("lateral")
    bus.run(20.0)
    assert {state.quality for state in bus.states.values()} == {"good"}
    assert find_gap(bus, report) < GAP


def test_an_area_that_has_never_heard_of_its_parent_in_a_ring_does_not_take_powers_of_the_unloaded_grid_for_known():
    """Shifts drive 40 p.u. around the ring without any load, and the area itself has none."""
    feeder = make_ring_feeder(2014, 3, 2, decades=2.0, dense=0.9)
    assert feeder is not None
    bus = SimulatedBus(feeder.area_files(0.0, 0), feeder.telemetry())
    bus.kill("a1")
    bus.run(12.0)
    central = process_bad_data(feeder.network, feeder.measurements).result
    state = bus.states["a2"]
    rows = [central.network.row[bus_id] for bus_id in state.buses]
    assert state.quality == "relative-angle"
    assert state.removed == ()
    assert max(abs(np.array(state.vm) - central.vm[rows]) / state.sigma_vm) < 3


@pytest.mark.parametrize("strategy", ["admm", "angle-offset"])
def test_a_strategy_that_knows_one_bus_a_boundary_refuses_a_ring(strategy):
    scenario = replace(ring33(), strategy=strategy)
    expected = f"areas lateral and main share bus 6, 18: a ring, which strategy '{strategy}' cannot take"
    with pytest.raises(InvalidInputError, match=expected):
        check_with_strategy(scenario)
    for content in area_files_of(scenario, strategy=strategy):
        with pytest.raises(InvalidInputError, match=expected):
            make_protocol(content, Incarnation(1, 1), now=0.0, started_at=0.0)
