"""Scenarios of networks with phases: places of meters, zero injections by node, sigmas, readings and their units."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsse_core.errors import InvalidInputError, NotObservableError
from dsse_core.estimation.estimator import estimate_state
from dsse_core.grid.division import build_partition
from dsse_core.grid.measurement import MeasurementKind, Meter, Source, find_meter_problems
from dsse_core.grid.meter_table import list_ids
from dsse_core.grid.network import Network
from dsse_core.observability import check_observable
from scenarios.check import check_scenario
from scenarios.files.network_file import load_case
from scenarios.files.readings.columns import read_sound_columns
from scenarios.files.readings.file import load_readings, save_readings
from scenarios.files.scenario_file import MeasurementsTable
from scenarios.meters import build_meters, build_sigma_rule, find_place_problems
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.ieee_feeders import load_feeder

IEEE13 = load_case("ieee13")
KIND = MeasurementKind


def of_keys(keys: Mapping[str, object]) -> MeasurementsTable:
    """Measurements with the places of each key, all of one sigma."""
    tables: dict[str, object] = {}
    for key, places in keys.items():
        if key == "zero_injection":
            tables[key] = places
        else:
            listed = "branches" if key in ("flow", "current") else "buses"
            tables[key] = {listed: places, "sigma_deg" if key == "angle" else "sigma_percent": 1.0}
    return MeasurementsTable.model_validate(tables)


def ids_of(keys: Mapping[str, object], network: Network = IEEE13) -> list[str]:
    return list_ids(build_meters(of_keys({"zero_injection": "measured"} | dict(keys)), network))


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"voltage": [645]}, ["vm@645.b", "vm@645.c"]),
        ({"voltage": ["611.c", "671.ab"]}, ["vm@611.c", "vm@671.ab"]),
        ({"angle": [684]}, ["va@684.a", "va@684.c"]),
        ({"current": ["671-684"]}, ["current@671.a:671-684", "current@671.c:671-684"]),
        ({"flow": ["671-684.c"]}, ["p_flow@671.c:671-684", "q_flow@671.c:671-684"]),
        ({"flow": ["632-670.total"]}, ["p_flow@632:632-670", "q_flow@632:632-670"]),
        ({"injection": ["646.bc"]}, ["p_injection@646.bc", "q_injection@646.bc"]),
        ({"injection": [646]}, ["p_injection@646.b", "q_injection@646.b", "p_injection@646.c", "q_injection@646.c"]),
        ({"injection": [652, "634.total"]}, [f"{k}_injection@{at}" for at in ("652.a", "634") for k in "pq"]),
    ],
)
def test_a_place_is_each_phase_of_a_bus_or_branch_or_those_that_it_names(
    keys: Mapping[str, object], expected: list[str]
) -> None:
    assert ids_of(keys) == expected


def test_all_places_are_all_nodes_and_all_phases_of_the_branches_in_service() -> None:
    assert len(ids_of({"voltage": "all"})) == len(ids_of({"injection": "all"})) / 2 == IEEE13.n_nodes == 41
    assert len(ids_of({"flow": "all"})) == 2 * len(ids_of({"current": "all"})) == len(IEEE13.table.ports)


def test_nodes_without_load_and_source_inject_exactly_nothing_at_a_bus_where_another_phase_has_a_load() -> None:
    meters = build_meters(of_keys({"injection": "all"}), IEEE13)
    virtual = {m.at for m in meters if m.source is Source.VIRTUAL}
    assert {"645.c", "632.a", "684.c", "680.b"} <= virtual
    assert not {"645.b", "646.b", "646.c", "671.a", "1.a", "634.b"} & virtual
    nodes = {f"{bus.id}.{phase}" for bus in IEEE13.buses for phase in bus.phases}
    assert {m.at for m in meters if m.kind is KIND.P_INJECTION} == nodes - {"646.b", "646.c"} | {"646.bc"}
    listed = build_meters(of_keys({"zero_injection": [680, "645.c", "684.c"]}), IEEE13)
    assert [m.at for m in listed if m.kind is KIND.P_INJECTION] == ["680.a", "680.b", "680.c", "645.c", "684.c"]
    assert len(ids_of({"injection": "all"})) == 2 * IEEE13.n_nodes  # measured


def test_currents_of_loads_between_phases_sum_to_zero_and_a_load_that_can_be_told_apart_is_metered_itself() -> None:
    """Bus 646 has one load, from b to c; bus 671 has three, whose currents at its nodes no meter divides."""
    default = {"zero_injection": "virtual"}
    of_sums = [m for m in build_meters(of_keys(default), IEEE13) if m.kind.is_virtual]
    assert [m.id for m in of_sums] == ["i_real@646", "i_imag@646", "i_real@671", "i_imag@671"]
    assert all(m.source is Source.VIRTUAL for m in of_sums)
    assert ids_of(default | {"zero_injection": [646], "injection": [646]}) == [
        "p_injection@646.bc",
        "q_injection@646.bc",
        "i_real@646",
        "i_imag@646",
    ]
    assert [i for i in ids_of(default | {"injection": "all"}) if "p_injection@671" in i or "p_injection@646" in i] == [
        "p_injection@671.a",
        "p_injection@671.b",
        "p_injection@671.c",
        "p_injection@646.bc",
    ]
    # two loads, a to b and b to c: each is read where the other is not
    loads = tuple(load for load in IEEE13.loads if load.bus != 671 or load.phases != "ca")
    apart = replace(IEEE13, loads=loads)
    assert {"p_injection@671.ab", "p_injection@671.cb"} <= set(ids_of(default | {"injection": [671]}, apart))
    wrong = of_keys({"injection": ["671.bc", "671.ab"]})
    assert list(find_place_problems(wrong, apart)) == [
        "measurements.injection.buses: '671.bc': other loads of bus 671 draw at b, and a meter reads the current "
        "there; name the leg '671.cb'"
    ]


def test_readings_between_two_phases_are_refused_where_they_are_others_or_no_load_stands(tmp_path: Path) -> None:
    rows = ["vm@671.ab,1.0,0.01,,", "p_injection@646.bc,,,-230,10"]
    wrong = {
        "vm@671.ba,1.0,0.01,,": "meter vm@671.ba has a reading in line 2 already, as vm@671.ab; keep one",
        "p_injection@671.ab,,,-385,10": "meter p_injection@671.ab: other loads of bus 671 draw at a, and a meter reads "
        "the current there; meter each phase",
        "p_injection@675.ab,,,-385,10": "meter p_injection@675.ab: no load of bus 675 stands between a and b; name one "
        "phase",
        "p_injection@646.cb,,,-230,10": "meter p_injection@646.cb has a reading in line 3 already, as "
        "p_injection@646.bc; keep one",
    }
    path = tmp_path / "readings.csv"

    def load(lines: list[str]) -> list[str]:
        text = "\n".join(["meter,value_pu,sigma_pu,value_kw,sigma_kw", *lines])
        path.write_text(text)
        assert (read_sound_columns(text, IEEE13) is not None) == (lines == rows)
        return [m.meter.id for m in load_readings(path, IEEE13)]

    assert load(rows) == ["vm@671.ab", "p_injection@646.bc"]
    with pytest.raises(InvalidInputError) as refused:
        load([*rows, *wrong])
    assert refused.value.problems == tuple(f"line {k}: {problem}" for k, problem in enumerate(wrong.values(), 4))
    for row in wrong:
        with pytest.raises(InvalidInputError, match="1 problem"):
            load([*rows, row])
    twice = [Meter(KIND.VM, 671, phases=phases) for phases in ("ab", "ba")]
    assert list(find_meter_problems(IEEE13, twice)) == [
        "meter vm@671.ba is given as .ab as well; keep one reading of each quantity"
    ]


def test_every_place_whose_phases_are_not_there_is_named_with_the_cure() -> None:
    keys = {
        "voltage": [99, "611.a", 671, "671.a", "671.total", "646.bcb"],
        "flow": ["671-684.b", "632-670.ab", "632-999.a", "632-670.c", "632-670."],
        "angle": ["646.cb", "646.bc", "646.b"],
        "current": ["632-670.total"],
        "injection": ["671.ab", "646.cb", "675.ab"],
        "zero_injection": ["645.b", "611.b", "680.ab"],
    }
    assert list(find_place_problems(of_keys(keys), IEEE13)) == [
        "measurements.voltage.buses: bus 99 is not in network 'ieee13'",
        "measurements.voltage.buses: '611.a': bus 611 has no phase a, only c",
        "measurements.voltage.buses: '646.bcb': after the point name one phase, or two of b, c",
        "measurements.voltage.buses: '671.total': after the point name one phase, or two of a, b, c",
        "measurements.voltage.buses: bus 671 is listed, and '671.a' as well; keep one",
        "measurements.angle.buses: bus 646.cb is listed, and '646.bc' as well; keep one",
        "measurements.injection.buses: '671.ab': other loads of bus 671 draw at a, and a meter reads the current "
        "there; meter each phase",
        "measurements.injection.buses: '675.ab': no load of bus 675 stands between a and b; name one phase",
        "measurements.zero_injection: '611.b': bus 611 has no phase b, only c",
        "measurements.zero_injection: bus 645.b has a load or a source in the network file; remove it here",
        "measurements.zero_injection: '680.ab': after the point name one phase of a, b, c",
        "measurements.flow.branches: branch '632-670.' is not in network 'ieee13'; a branch is called FROM-TO unless "
        "the network file gives it an id",
        "measurements.flow.branches: '632-670.ab': after the point name one phase of a, b, c, or 'total'",
        "measurements.flow.branches: branch '632-999.a' is not in network 'ieee13'; a branch is called FROM-TO unless "
        "the network file gives it an id",
        "measurements.flow.branches: '671-684.b': branch 671-684 has no phase b, only a, c",
        "measurements.current.branches: '632-670.total': after the point name one phase of a, b, c",
    ]


def test_a_balanced_network_has_no_phases_to_name() -> None:
    problems = list(find_place_problems(of_keys({"voltage": [1, "3.a"], "flow": ["3-4.total"]}), load_case("ieee33")))
    assert problems == [
        "measurements.voltage.buses: '3.a': bus 3 has no phases; leave out '.a'",
        "measurements.flow.branches: '3-4.total': branch 3-4 has no phases; leave out '.total'",
    ]


def test_sigmas_in_percent_refer_to_the_apparent_power_of_the_phase_and_have_a_floor_in_each() -> None:
    table = MeasurementsTable.model_validate(
        {
            "floor_kva": 2.0,
            "flow": {"branches": "all", "sigma_percent": 2.0},
            "voltage": {"buses": "all", "sigma_pu": 0.01},
        }
    )
    meters = [Meter(KIND.VM, 671, phases="a"), Meter(KIND.P_FLOW, 632, "632-670", phases="b")]
    sigmas = build_sigma_rule(table, IEEE13).sigmas([*meters, meters[1]], np.array([1.0, 0.5, 0.0]))
    assert sigmas.tolist() == pytest.approx([0.01, 0.01, 2.0 / (5000 / 3)], rel=1e-12)


READINGS = """meter,value_pu,sigma_pu,value_kv,sigma_kv,value_kw,sigma_kw,value_a,sigma_a
vm@671.a,0.99,0.002,,,,,,
vm@675.ab,,,4.16,0.02,,,,
vm@611.c,,,2.4,0.01,,,,
p_injection@634.b,,,,,-120,2,,
p_injection@646.bc,,,,,-230,2,,
p_flow@632:632-670,,,,,3500,5,,
p_flow@632.a:632-670,,,,,1050,5,,
current@632.a:632-670,,,,,,,500,1
"""


def test_readings_of_phases_are_to_ground_and_of_a_third_of_the_base_and_totals_of_all(tmp_path: Path) -> None:
    path = tmp_path / "readings.csv"
    path.write_text(READINGS)
    readings = load_readings(path, IEEE13)
    third = 5000 / 3
    expected = [0.99, math.sqrt(3), 2.4 / (4.16 / math.sqrt(3)), -120 / third, -230 / third, 3500 / 5000, 1050 / third]
    expected += [500 / (5000 / (math.sqrt(3) * 4.16))]
    assert [m.value for m in readings] == pytest.approx(expected, rel=1e-12)
    assert [m.meter.id for m in readings] == [line.split(",")[0] for line in READINGS.splitlines()[1:]]
    sound = read_sound_columns(READINGS, IEEE13)
    assert sound is not None
    assert sound.readings == readings
    save_readings(path, IEEE13, readings)
    assert [m.value for m in load_readings(path, IEEE13)] == pytest.approx(expected, rel=1e-15)


def test_readings_of_phases_that_are_not_there_are_refused_with_those_that_are(tmp_path: Path) -> None:
    path = tmp_path / "readings.csv"
    rows = ["vm@671", "vm@611.a", "p_flow@671.b:671-684", "vm@671.abc", "current@671:671-684", "vm@671.q"]
    rows += ["p_flow@671:671-684.c", "p_injection@671.total", "vm@671.b"]
    path.write_text("meter,value_pu,sigma_pu\n" + "".join(f"{row},1.0,0.1\n" for row in rows))
    with pytest.raises(InvalidInputError) as caught:
        load_readings(path, IEEE13)
    assert [problem.partition(": ")[2] for problem in caught.value.problems] == [
        "meter vm@671: name one phase, or two of bus 671, which has a, b, c",
        "meter vm@611.a: phase a is not there, only c",
        "meter p_flow@671.b:671-684: phase b is not there, only a, c",
        "meter vm@671.abc: name one phase, or two of bus 671, which has a, b, c",
        "meter current@671:671-684: name one phase of bus 671, which has a, b, c",
        "'vm@671.q' is no meter id: 'q' names no phases of a, b, c, s1, s2",
        "meter p_flow@671:671-684.c: branch 671-684.c is not in network 'ieee13'; a phase stands behind the bus, as "
        "p_flow@671.c:671-684",
        "'p_injection@671.total' is no meter id: 'total' names no phases of a, b, c, s1, s2; a total has the id "
        "p_injection@671",
    ]


def test_the_shipped_feeder_is_observable_and_its_noise_is_what_its_sigmas_say() -> None:
    scenario = load_scenario("ieee13")
    check_scenario(scenario)
    boundaries = {(a.name, n.area): a.boundaries[n.area].phases for a in scenario.partition.areas for n in a.neighbours}
    assert boundaries == {
        ("area1", "area2"): {632: "abc"},
        ("area2", "area1"): {632: "abc"},
        ("area2", "area3"): {671: "ac"},
        ("area3", "area2"): {671: "ac"},
    }
    objectives = []
    for scan in range(1, 11):
        telemetry = make_telemetry(scenario, scan)
        found = estimate_state(scenario.network, telemetry.union)
        objectives.append(found.objective)
        assert telemetry.truth is not None
        assert abs(found.vm - telemetry.truth.vm).max() < 0.02
    freedom = found.degrees_of_freedom
    assert abs(np.mean(objectives) - freedom) < 4 * math.sqrt(2 * freedom / 10)


def test_keys_of_areas_that_solve_a_power_flow_of_their_own_are_refused_with_phases() -> None:
    changes = {"telemetry.source": "area-power-flow", "faults.load_error.all": {"p_mw": 0.1, "q_mvar": 0.0}}
    with pytest.raises(InvalidInputError) as caught:
        load_scenario("ieee13", changes=changes)
    source, load_error = caught.value.problems
    assert source.startswith(
        "telemetry.source: 'area-power-flow' does not suit network 'ieee13': its buses have phases"
    )
    assert load_error.startswith("faults.load_error: the buses of network 'ieee13' have phases")


def test_a_power_added_on_a_link_is_shared_by_the_phases_of_its_boundary() -> None:
    """Areas meet at 632 with three phases and at 671 with two."""
    power, areas = {"p_mw": 0.3, "q_mvar": -0.6}, [("area1", "area2", 3), ("area2", "area3", 2)]
    links = [{"from": one, "to": other, "load": power, "lie": power} for one, other, _ in areas]
    faults = load_scenario("ieee13", changes={"faults.link": links}).faults.links
    for one, other, n in areas:
        found = faults[one, other]
        for p, q in ((found.load_p, found.load_q), (found.lie_p, found.lie_q)):
            assert n * p * IEEE13.node_mva == pytest.approx(0.3)
            assert n * q * IEEE13.node_mva == pytest.approx(-0.6)


def test_the_phase_of_a_lateral_that_no_meter_determines_is_named_with_its_cure() -> None:
    changes = {
        "measurements.zero_injection": [2, 650, 60, 632, 633, 680, "645.c", "684.a"],
        "measurements.injection.buses": [1, 634, 645, 646, 670, 671, 675, 652],
        "measurements.voltage.buses": [650, 634, 671],
        "measurements.flow.branches": ["671-684", "sub"],
    }
    with pytest.raises(InvalidInputError) as caught:
        check_scenario(load_scenario("ieee13", changes=changes))
    (problem,) = caught.value.problems
    assert problem.startswith("whole grid: the measurements do not determine the state of bus 611.c; any one of these")
    assert "P and Q injection at bus 611.c" in problem


def test_voltages_of_whole_buses_in_parts_without_ground_are_between_phases() -> None:
    """Behind its delta winding the feeder of 37 buses has no ground; the bus of its source has."""
    network = load_feeder("ieee37")
    expected = ["vm@1800.a", "vm@1800.b", "vm@1800.c", "vm@701.ab", "vm@701.bc", "vm@701.ca"]
    assert ids_of({"voltage": [701, 1800]}, network) == expected
    every = build_meters(of_keys({"voltage": "all", "angle": [702]}), network)
    assert list(find_meter_problems(network, every)) == []


@pytest.mark.parametrize("place", ["632-670+632-633", "632-670,632-633", "632-670.total+632-633.total"])
def test_a_sum_over_elements_of_several_branches_is_no_place(place: str) -> None:
    (problem,) = find_place_problems(of_keys({"flow": [place]}), IEEE13)
    assert problem.startswith(f"measurements.flow.branches: branch {place!r} is not in network 'ieee13'")


def test_a_reading_of_phases_that_inject_exactly_nothing_is_refused_by_node_or_bus(tmp_path: Path) -> None:
    readings, scenario = tmp_path / "readings.csv", tmp_path / "scenario.toml"
    totals = "p_injection@680,5,1\np_injection@645,-170,2\n"  # of bus 680 nothing has a load, of 645 one phase
    readings.write_text(f"meter,value_kw,sigma_kw\np_injection@645.c,0,1\np_injection@645.b,-170,2\n{totals}")
    text = 'version = 1\ndescription = "readings"\nnetwork = "ieee13"\nareas = { count = 2 }\n'
    scenario.write_text(f'{text}[telemetry]\nsource = "file"\nfile = "readings.csv"\n')
    with pytest.raises(InvalidInputError, match=r"says that bus 645\.c injects exactly nothing") as caught:
        load_scenario(scenario)
    assert len(caught.value.problems) == 2
    assert "p_injection@680 has a reading, but" in caught.value.problems[1]


def find_gap(*injections: int | str) -> NotObservableError:
    changes = {"measurements.voltage.buses": [650], "measurements.flow.branches": ["60-632", "632-670"]}
    scenario = load_scenario("ieee13", changes=changes | {"measurements.injection.buses": list(injections)})
    with pytest.raises(NotObservableError) as caught:
        check_observable(scenario.network, scenario.meters)
    return caught.value


def test_the_unobservable_phases_of_a_lateral_are_named_with_the_meters_that_cure_them() -> None:
    lateral = find_gap(634, 646, 645, 675, 670)
    assert "the state of bus 684 (a, c), 611.c, 652.a; any one of these added meters would cure it" in str(lateral)
    assert "P and Q flow of branch 684-652 at bus 684.a" in lateral.cures


def test_a_few_meters_are_named_that_cure_together_where_none_does_alone() -> None:
    injections = (646, 671, "634.a", "634.c", "675.a", "675.b", 652, 670)
    apart = find_gap(*injections)
    assert (apart.cures, len(apart.together)) == ((), 2)
    assert f"together these would: {'; '.join(apart.together)}" in str(apart)
    named = [re.search(r"branch (\S+) at bus \d+\.(\w)$", cure) for cure in apart.together]
    added = [f"{found[1]}.{found[2]}" for found in named if found]
    changes = {"measurements.voltage.buses": [650], "measurements.injection.buses": list(injections)}
    changes["measurements.flow.branches"] = ["60-632", "632-670", *added]
    check_scenario(load_scenario("ieee13", changes=changes))


def test_the_whole_grid_without_areas_knows_its_unloaded_voltages():
    (grid,) = load_scenario("ieee13", whole=True).partition.areas
    (area,) = build_partition(IEEE13, {"grid": [bus.id for bus in IEEE13.buses]}).areas
    assert np.allclose(grid.find_no_load(), area.find_no_load(), rtol=0, atol=1e-12)
