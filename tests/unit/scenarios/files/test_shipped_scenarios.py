"""The shipped scenarios: all load, all are observable, and they say what the documentation promises."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from agents.strategies.angle_offset import AngleOffset
from coordinator.lab.strategy_check import check_with_strategy
from dsse_core.errors import InvalidInputError
from dsse_core.grid.measurement import MeasurementKind, Meter, Source
from dsse_core.link_faults import LinkFaults
from scenarios.files.shipped_files import find_shipped
from scenarios.scenario import list_scenarios, load_scenario

NAMES = [
    "case33bw",
    "ieee123",
    "ieee13",
    "ieee33",
    "ieee33-bursts",
    "ieee33-corruption",
    "ieee33-cut",
    "ieee33-disorder",
    "ieee33-liar",
    "ieee33-load-error",
    "ieee33-lossy",
    "ieee33-restart",
    "ieee33-thesis",
    "ieee33-thesis-load-error",
    "industrial13",
    "industrial13-load-error",
    "industrial13-lossy",
    "industrial13-thesis",
    "industrial13-thesis-load-error",
    "industrial13-thesis-message-error",
]


def test_the_list_of_scenarios_is_complete_sorted_and_described() -> None:
    assert [name for name, _ in list_scenarios()] == NAMES
    assert all(description for _, description in list_scenarios())


@pytest.mark.parametrize("name", NAMES)
def test_every_shipped_scenario_loads_and_is_observable_as_a_whole_and_in_each_area(name: str) -> None:
    scenario = load_scenario(name)
    check_with_strategy(scenario)
    assert scenario.name == name
    assert scenario.path == find_shipped("shipped")[name]


def test_a_strategy_that_turns_all_phases_alike_refuses_them() -> None:
    expected = "buses have phases, which strategy 'angle-offset' cannot take: one offset turns all phases alike.*'admm'"
    with pytest.raises(InvalidInputError, match=expected):
        check_with_strategy(load_scenario("ieee13", changes={"strategy": "angle-offset"}))
    check_with_strategy(load_scenario("ieee13", changes={"strategy": "admm"}))


@pytest.mark.parametrize("name", NAMES)
def test_every_shipped_file_is_commented(name: str) -> None:
    assert find_shipped("shipped")[name].read_text(encoding="utf-8").startswith("# ")


@pytest.mark.parametrize("case", ["industrial13", "ieee33"])
def test_the_variants_of_a_case_differ_in_their_fault_and_where_load_messages_matter_in_their_meters_only(
    case: str,
) -> None:
    plain = load_scenario(case)
    lossy, wrong = load_scenario(f"{case}-lossy"), load_scenario(f"{case}-load-error")
    for other in (lossy, wrong):
        assert (other.sigma_rule, other.telemetry, other.partition) == (
            plain.sigma_rule,
            plain.telemetry,
            plain.partition,
        )
    assert lossy.meters == plain.meters
    assert set(wrong.meters) < set(plain.meters)  # with all of them, the load message would hardly count
    assert wrong.strategy == "angle-offset"  # which alone uses load messages as measurements
    assert {link.loss for link in load_scenario(f"{case}-lossy").faults.links.values()} == {0.3}
    assert set(load_scenario(f"{case}-load-error").load_error.values()) == {0.03 + 0.03j}  # 10 MVA base
    assert set(plain.faults.links.values()) == {LinkFaults()}
    assert set(plain.load_error.values()) == {0j}


def test_a_link_may_have_a_loss_of_its_own_in_one_direction(tmp_path: Path) -> None:
    text = find_shipped("shipped")["ieee33-lossy"].read_text(encoding="utf-8")
    path = tmp_path / "one-way.toml"
    path.write_text(text + '\n[[faults.link]]\nfrom = "area1"\nto = "area2"\nloss = 1.0\n', encoding="utf-8")
    loss = {link: faults.loss for link, faults in load_scenario(path).faults.links.items()}
    assert loss == {
        ("area1", "area2"): 1.0,
        ("area2", "area1"): 0.3,
        ("area1", "area3"): 0.3,
        ("area3", "area1"): 0.3,
    }


def test_the_thesis_13_bus_case_has_the_29_measurements_of_table_5_2() -> None:
    assert len(load_scenario("industrial13-thesis").meters) == 29


def test_zero_injections_are_exact_constraints_and_never_metered_as_well() -> None:
    scenario = load_scenario("industrial13")
    injections = [m for m in scenario.meters if m.kind.of_injection]
    assert {m.bus for m in injections if m.source is Source.VIRTUAL} == {2, 6, 7, 8}
    assert len(injections) == 2 * 13


def test_no_boundary_bus_has_an_injection_meter_under_area_power_flow() -> None:
    scenario = load_scenario("ieee33-thesis")
    assert {m.bus for m in scenario.meters if m.kind.of_injection} == set(range(1, 34)) - {6}


def test_no_meter_stands_on_an_open_tie() -> None:
    branches = {m.branch for m in load_scenario("ieee33").meters if m.branch}
    assert len(branches) == 32
    assert "25-29" not in branches


def test_an_area_without_voltage_meter_is_checked_with_its_local_slack_voltage() -> None:
    scenario = load_scenario("industrial13-thesis")
    area = scenario.partition.area("area1")
    own = [m for m in scenario.meters if scenario.partition.area_of_meter(m) == "area1"]
    assert not any(m.kind is MeasurementKind.VM for m in own)
    voltages = [m for m in AngleOffset.local_meters(area, own) if m.kind is MeasurementKind.VM]
    assert [(m.bus, m.source) for m in voltages] == [(4, Source.PSEUDO)]


def test_an_area_that_its_own_meters_do_not_observe_is_named_with_its_buses() -> None:
    scenario = load_scenario("ieee33")
    unread = ("16-17", "17-18")  # and no injection at 16, which would give the flow of 16-17
    blind = tuple(
        m for m in scenario.meters if m.branch not in unread and not (m.kind.of_injection and m.bus in (16, 17, 18))
    )
    with pytest.raises(InvalidInputError) as caught:
        check_with_strategy(replace(scenario, meters=blind, strategy="angle-offset"))
    whole, area = caught.value.problems
    assert whole.startswith("whole grid: the measurements do not determine the state of bus 17, 18;")
    assert area.startswith("area area2: the measurements do not determine the state of bus 17, 18;")


def test_angle_meters_are_rejected_where_each_area_reads_its_own_power_flow() -> None:
    scenario = load_scenario("ieee33-thesis")
    angles = tuple(Meter(MeasurementKind.VA, bus) for bus in (16, 30))
    with pytest.raises(InvalidInputError) as caught:
        check_with_strategy(replace(scenario, meters=(*scenario.meters, *angles)))
    (problem,) = caught.value.problems
    assert problem.startswith(
        "measurements.angle: bus 16, 30 has an angle meter, but with telemetry.source 'area-power"
    )
    shared = load_scenario("ieee33")
    check_with_strategy(replace(shared, meters=(*shared.meters, *angles)))


def test_only_the_substations_area_is_checked_with_its_angle_meters() -> None:
    scenario = load_scenario("ieee33")
    for area in scenario.partition.areas:
        angle = Meter(MeasurementKind.VA, area.network.buses[-1].id)
        assert (angle in AngleOffset.local_meters(area, [angle])) == (area.name == "area1")


@pytest.mark.parametrize("missing", [MeasurementKind.P_INJECTION, MeasurementKind.Q_INJECTION])
def test_a_substation_without_injection_meters_is_rejected_where_generation_is_telemetered(
    missing: MeasurementKind,
) -> None:
    scenario = load_scenario("ieee33")
    meters = tuple(m for m in scenario.meters if not (m.kind is missing and m.bus == 1))
    scenario = replace(scenario, meters=meters, strategy="angle-offset")
    with pytest.raises(InvalidInputError) as caught:
        check_with_strategy(scenario)
    (problem,) = caught.value.problems
    assert "the substation, bus 1, has no meters of P and Q injection" in problem
    assert "measurements.injection.buses" in problem
    check_with_strategy(replace(scenario, generation="scheduled"))
    check_with_strategy(replace(scenario, strategy="information"))  # there load messages only start the iteration


def test_only_angle_offset_asks_that_each_area_be_observable_alone() -> None:
    scenario = load_scenario("ieee33")
    blind = tuple(m for m in scenario.meters if scenario.partition.area_of_meter(m) != "area3")
    with pytest.raises(InvalidInputError) as caught:
        check_with_strategy(replace(scenario, meters=blind, strategy="information"))
    assert [p.split(":")[0] for p in caught.value.problems] == ["whole grid"]
    with pytest.raises(InvalidInputError) as caught:
        check_with_strategy(replace(scenario, meters=blind, strategy="angle-offset"))
    assert [p.split(":")[0] for p in caught.value.problems] == ["whole grid", "area area3"]
