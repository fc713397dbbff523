"""Every mistake in a scenario file is refused, naming key, what was found and what is allowed; all at once."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from coordinator.fault_schedule import FaultSchedule
from dsse_core.errors import InvalidInputError
from dsse_core.link_faults import LinkFaults
from scenarios.scenario import load_scenario
from scenarios.shipped_files import find_shipped

GOOD = find_shipped("shipped")["ieee33"].read_text(encoding="utf-8")


def problems_of(tmp_path: Path, text: str) -> tuple[str, ...]:
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidInputError) as caught:
        load_scenario(path, strategies=("angle-offset", "information"))
    assert str(path) in caught.value.what
    return caught.value.problems


def changed(old: str, new: str) -> str:
    assert old in GOOD
    return GOOD.replace(old, new, 1)


def the_only(problems: tuple[str, ...]) -> str:
    assert len(problems) == 1, problems
    return problems[0]


def test_an_unknown_key_is_refused_with_the_allowed_ones_and_the_closest(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("noise = true", "noise = true\nnois = true")))
    allowed = "source, file, noise, gross_error"
    assert problem == f"telemetry.nois: unknown key; allowed here: {allowed}; did you mean 'noise'?"


def test_an_unknown_key_at_the_top_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("seed = 1", "seeed = 1")))
    assert problem.startswith("seeed: unknown key; allowed here: version, description, seed, network,")


def test_an_unknown_key_inside_a_named_area_is_refused_with_what_an_area_allows(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("[areas.area2]", "[areas.area2]\nbusses = [1]")))
    assert problem == (
        "areas.area2.busses: unknown key; allowed here: buses, slack_bus, slack_vm_pu; did you mean 'buses'?"
    )


def test_an_unknown_key_inside_a_list_of_tables_is_refused_with_its_position(tmp_path: Path) -> None:
    text = GOOD + '\n[[faults.link]]\nfrom = "area1"\nto = "area2"\nloss = 0.1\ndelay = 1\n'
    assert the_only(problems_of(tmp_path, text)) == (
        "faults.link[0].delay: unknown key; allowed here: from, to, loss, burst, delay_ms, jitter_ms, duplicate, "
        "corrupt, load, lie; did you mean 'delay_ms'?"
    )


def test_a_missing_key_is_named_with_its_meaning(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('network = "ieee33"', "")))
    assert (
        problem == "network: missing; name of a shipped network, or path of a .toml or .json file relative to this file"
    )


def test_missing_measurements_are_named(tmp_path: Path) -> None:
    text = GOOD[: GOOD.index("[measurements]")]
    assert the_only(problems_of(tmp_path, text)).startswith("measurements: there is no meter")


def test_bad_toml_is_reported_with_its_line(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, "version = 1\nseed = = 2\n"))
    assert "not valid TOML" in problem
    assert "line 2" in problem


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="check the path"):
        load_scenario(tmp_path / "absent.toml")


def test_a_file_that_is_no_text_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(b"version = 1 # \xff\n")
    with pytest.raises(InvalidInputError, match="not UTF-8"):
        load_scenario(path)


def test_an_unknown_shipped_scenario_is_refused_with_the_names_and_the_closest() -> None:
    with pytest.raises(InvalidInputError, match=r"shipped: ieee33, ieee33-bursts.*did you mean 'ieee33-lossy'"):
        load_scenario("ieee33-losy")


def test_another_version_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("version = 1", "version = 2")))
    assert problem.startswith("version: must be 1, found 2")


def test_a_negative_seed_is_refused(tmp_path: Path) -> None:
    assert the_only(problems_of(tmp_path, changed("seed = 1", "seed = -1"))).startswith("seed: must be greater")


def test_a_text_in_place_of_a_number_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("floor_kva = 1.0", 'floor_kva = "1"')))
    assert problem.startswith("measurements.floor_kva: must be a valid number, found '1'")


def test_an_infinite_number_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("floor_kva = 1.0", "floor_kva = inf")))
    assert problem.startswith("measurements.floor_kva: must be a finite number")


def test_a_whole_number_is_good_enough_for_a_quantity(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(changed("floor_kva = 1.0", "floor_kva = 1"), encoding="utf-8")
    assert load_scenario(path).meters


def test_an_unknown_strategy_is_refused_with_the_allowed_ones(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('"information"', '"magic"')))
    assert problem == "strategy: unknown strategy 'magic'; allowed: angle-offset, information"


def test_a_strategy_that_the_caller_knows_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(changed('"information"', '"admm"'), encoding="utf-8")
    assert load_scenario(path, strategies=("angle-offset", "admm")).strategy == "admm"


def test_an_unknown_network_is_refused_with_those_that_are_shipped(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('network = "ieee33"', 'network = "ieee34"')))
    assert "shipped: ieee33, industrial13; did you mean 'ieee33'?" in problem
    assert problem.startswith("network: ")


def test_a_network_file_that_is_missing_is_reported_with_its_path(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('network = "ieee33"', 'network = "grid.toml"')))
    assert str(tmp_path / "grid.toml") in problem


def test_problems_inside_the_network_file_appear_in_the_report_of_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "grid.toml").write_text("base_mva = -1.0\n", encoding="utf-8")
    problems = problems_of(tmp_path, changed('network = "ieee33"', 'network = "grid.toml"'))
    assert any("base_mva: must be greater than 0, found -1.0" in p for p in problems)
    assert any("bus: missing" in p for p in problems)


@pytest.mark.parametrize("sigma", ["0.0", "-0.2", "1e-200"])
def test_a_sigma_that_is_not_positive_in_the_squares_is_refused(tmp_path: Path, sigma: str) -> None:
    problem = the_only(problems_of(tmp_path, changed("sigma_percent = 0.2", f"sigma_percent = {sigma}")))
    assert problem.startswith(
        "measurements.voltage.sigma_percent: must be greater than or equal to 0.000000001, found "
    )


@pytest.mark.parametrize(("sigmas", "found"), [("", "neither"), (", sigma_percent = 1.0, sigma_pu = 0.1", "both")])
def test_two_sigmas_or_none_are_refused(tmp_path: Path, sigmas: str, found: str) -> None:
    problem = the_only(problems_of(tmp_path, changed(", sigma_percent = 0.2", sigmas)))
    assert problem.startswith("measurements.voltage: give exactly one of sigma_percent")
    assert problem.endswith(f"found {found}")


def test_a_scenario_without_any_meter_is_refused(tmp_path: Path) -> None:
    text = "\n".join(line for line in GOOD.splitlines() if not line.startswith(("voltage", "flow", "injection")))
    assert the_only(problems_of(tmp_path, text)).startswith("measurements: there is no meter")


def test_a_selection_that_is_neither_all_nor_a_list_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('branches = "all"', 'branches = "some"')))
    assert problem.startswith('measurements.flow.branches: must be "all" or a list of branch ids')


def test_half_a_local_slack_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("[areas.area2]", "[areas.area2]\nslack_bus = 16")))
    assert problem == "areas.area2: slack_bus and slack_vm_pu belong together; give both or none"


def test_a_local_slack_outside_its_area_is_refused(tmp_path: Path) -> None:
    text = changed("[areas.area2]", "[areas.area2]\nslack_bus = 1\nslack_vm_pu = 1.0")
    assert the_only(problems_of(tmp_path, text)) == "areas: area area2: slack_bus 1 is not one of its buses"


def test_an_area_name_with_a_blank_or_a_capital_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("[areas.area2]", '[areas."Area 2"]')))
    assert problem.startswith("areas.Area 2: must match pattern")


def test_a_bus_in_no_area_is_named(tmp_path: Path) -> None:
    problems = problems_of(tmp_path, changed("24, 25]", "24]"))
    assert "areas: bus 25 is in no area; add it to the buses of one" in problems


def test_an_area_in_pieces_is_named(tmp_path: Path) -> None:
    problems = problems_of(tmp_path, changed("buses = [30, 31,", "buses = [18, 30, 31,"))
    assert any("area area3 is not connected" in p for p in problems)


def test_a_loop_of_areas_is_named(tmp_path: Path) -> None:
    problems = problems_of(tmp_path, changed("27, 26, 6]", "27, 26, 6, 5]"))
    assert any("loop" in p and "area1" in p and "area3" in p for p in problems)


def test_meters_at_unknown_and_repeated_places_are_named_with_their_keys(tmp_path: Path) -> None:
    text = changed("[1, 16, 22, 30]", "[1, 99, 22, 22]").replace('branches = "all"', 'branches = ["1-2", "2-1"]')
    problems = problems_of(tmp_path, text)
    assert problems[0] == "measurements.voltage.buses: bus 22 is listed twice; keep one"
    assert problems[1] == "measurements.voltage.buses: bus 99 is not in network 'ieee33'"
    assert problems[2].startswith("measurements.flow.branches: branch '2-1' is not in network 'ieee33'")
    assert len(problems) == 3


def test_a_meter_on_a_branch_out_of_service_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('branches = "all"', 'branches = ["1-2", "25-29"]')))
    assert problem == ("measurements.flow.branches: branch '25-29' is out of service; remove it from the list")


@pytest.mark.parametrize("loss", ["-0.1", "1.5"])
def test_a_loss_that_is_no_probability_is_refused(tmp_path: Path, loss: str) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + f"\n[faults]\nloss = {loss}\n"))
    assert problem.startswith("faults.loss: must be ")
    assert f"found {loss}" in problem


def test_a_load_error_of_an_unknown_area_is_refused(tmp_path: Path) -> None:
    text = GOOD + "\n[faults.load_error.area9]\np_mw = 0.3\nq_mvar = 0.3\n"
    assert the_only(problems_of(tmp_path, text)) == (
        "faults.load_error.area9: there is no area 'area9'; areas: area1, area2, area3"
    )


def test_a_load_error_without_its_reactive_part_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + "\n[faults.load_error.area1]\np_mw = 0.3\n"))
    assert problem.startswith("faults.load_error.area1.q_mvar: missing;")


def link(sender: str, receiver: str) -> str:
    return f'\n[[faults.link]]\nfrom = "{sender}"\nto = "{receiver}"\nloss = 0.5\n'


def test_a_link_of_an_unknown_area_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + link("area1", "area9")))
    assert problem == "faults.link[0].to: there is no area 'area9'; areas: area1, area2, area3"


def test_a_link_between_areas_that_are_not_neighbours_is_refused_with_the_links(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + link("area2", "area3")))
    assert problem.startswith("faults.link[0]: area2 and area3 are not neighbours; links: area2 to area1,")


def test_a_link_that_is_given_twice_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + 2 * link("area1", "area2")))
    assert problem == "faults.link[1]: the link from area1 to area2 is given twice; keep one"


def events(*lines: str) -> str:
    return "\n[faults]\nevents = [" + ", ".join(f"{{ {line} }}" for line in lines) + "]\n"


def test_every_event_that_cannot_happen_is_refused_with_its_number(tmp_path: Path) -> None:
    text = GOOD + events(
        'at_s = 1, kill = "area9"',
        'at_s = 1, cut = ["area2", "area3"], for_s = 1',
        'at_s = 1, cut = ["area2", "plant"], for_s = 1',
        'at_s = 29, pause = "router", for_s = 1',
    )
    problems = problems_of(tmp_path, text)
    assert problems == (
        "faults.events[0].kill: there is no 'area9'; allowed: area1, area2, area3, plant, router",
        "faults.events[2].cut: there is no 'plant'; allowed: area1, area2, area3",
        "faults.events[3]: is over 30 s after the start, but run.timeout_s is 30; raise timeout_s or let it happen "
        "earlier",
        "faults.events[1].cut: area2 and area3 are not neighbours; links: area2 to area1, area3 to area1, "
        "area1 to area2, area1 to area3",
    )


def test_events_that_meet_what_is_dead_frozen_silent_or_cut_already_are_refused(tmp_path: Path) -> None:
    text = GOOD + events(
        'at_s = 9, kill = "area1"',  # lines need not be in the order of time
        'at_s = 1, kill = "area1"',
        'at_s = 2, pause = "area1", for_s = 1',
        'at_s = 3.5, restart = "area1"',
        'at_s = 1, pause = "plant", for_s = 3',
        'at_s = 2, silent = "plant", for_s = 5',
        'at_s = 1, cut = ["area1", "area2"], for_s = 2',
        'at_s = 2, cut = ["area2", "area1"], for_s = 2',
    )
    assert problems_of(tmp_path, text) == (
        "faults.events[2].pause: area1 is dead by then, killed by faults.events[1]; restart it before, or remove one "
        "of the two",
        "faults.events[5].silent: falls into faults.events[4], pause plant until 4 s; let it happen earlier or later",
        "faults.events[7].cut: falls into faults.events[6], cut area1 and area2 until 3 s; let it happen earlier or "
        "later",
    )


def test_an_event_may_begin_when_the_one_before_it_ends(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(GOOD + events('at_s = 1, pause = "area1", for_s = 1', 'at_s = 2, pause = "area1", for_s = 1'))
    steps = FaultSchedule.of(load_scenario(path).faults.events).steps
    assert [(step.at_s, step.kind) for step in steps] == [(1, "pause"), (2, "resume"), (2, "pause"), (3, "resume")]


def test_the_second_router_can_be_named_where_there_is_one(tmp_path: Path) -> None:
    happens = events('at_s = 1, kill = "router2"', 'at_s = 2, restart = "router2"')
    assert the_only(problems_of(tmp_path, GOOD + events('at_s = 1, kill = "router2"'))) == (
        "faults.events[0].kill: there is no 'router2' with transport.routers = 1; allowed: area1, area2, area3, plant, "
        "router"
    )
    path = tmp_path / "mine.toml"
    path.write_text(GOOD + "[transport]\nrouters = 2\n" + happens)
    assert [event.names for event in load_scenario(path).faults.events] == [("router2",), ("router2",)]


def test_there_is_no_router_to_kill_where_neighbours_link_directly(tmp_path: Path) -> None:
    text = GOOD + '[transport]\nkind = "neighbours"\n' + events('at_s = 1, restart = "router"')
    assert the_only(problems_of(tmp_path, text)) == (
        "faults.events[0].restart: there is no 'router' with transport.kind = \"neighbours\"; allowed: area1, area2, "
        "area3, plant"
    )


@pytest.mark.parametrize(
    ("event", "expected"),
    [
        ("at_s = 1", "give exactly one of kill, restart, pause, cut and silent, found none"),
        ('at_s = 1, kill = "area1", pause = "area2"', "found kill and pause"),
        ('at_s = 1, pause = "area1"', "pause lasts; say how long with for_s"),
        ('at_s = 1, restart = "area1", for_s = 2', "restart happens in a moment; remove for_s"),
        ('at_s = 1, cut = ["area1"], for_s = 2', "cut must name two neighbouring areas"),
    ],
)
def test_an_event_is_exactly_one_thing_that_lasts_or_does_not(tmp_path: Path, event: str, expected: str) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + events(event)))
    assert problem.startswith("faults.events[0]: ")
    assert expected in problem


def test_a_link_takes_what_it_does_not_say_from_all_links_and_cuts_from_events(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    own = '[[faults.link]]\nfrom = "area1"\nto = "area2"\nloss = 0.0\nlie = { va_deg = 1.0 }\n'
    cut = '[[faults.events]]\nat_s = 3\ncut = ["area2", "area1"]\nfor_s = 2\n'
    path.write_text(GOOD + "[faults]\nloss = 0.5\nburst = { enter = 0.1, leave = 0.5 }\ndelay_ms = 20\n" + own + cut)
    faults = load_scenario(path).faults
    everywhere = LinkFaults(loss=0.5, burst_enter=0.1, burst_leave=0.5, delay_s=0.02)
    cuts = ((3.0, 5.0),)
    assert faults.links["area1", "area2"] == replace(everywhere, loss=0.0, lie_va=math.radians(1.0), cuts=cuts)
    assert faults.links["area2", "area1"] == replace(everywhere, cuts=cuts)
    assert faults.links["area1", "area3"] == everywhere
    assert faults.over_s == 5.0


def gross_error(meter: str) -> str:
    return f'\n[[telemetry.gross_error]]\nmeter = "{meter}"\nsigmas = 20.0\n'


def test_a_gross_error_of_an_unknown_meter_is_refused_with_the_closest(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + gross_error("p_flow@4:3-4")))
    assert problem.startswith("telemetry.gross_error[0].meter: 'p_flow@4:3-4' is no meter of this scenario")
    assert "did you mean 'p_flow@" in problem


def test_a_gross_error_of_an_exact_zero_injection_is_refused(tmp_path: Path) -> None:
    text = find_shipped("shipped")["industrial13"].read_text(encoding="utf-8") + gross_error("p_injection@2")
    assert "p_injection@2 is an exact zero injection" in the_only(problems_of(tmp_path, text))


def test_a_listening_address_that_is_no_endpoint_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + '\n[transport]\nlisten = "127.0.0.1"\n'))
    assert problem.startswith("transport.listen: must match pattern")
    assert "tcp/HOST:PORT; port 0 takes a free one" in problem


def test_a_time_limit_shorter_than_two_beats_is_refused(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + "\n[run]\nbeat_s = 20.0\n"))
    assert problem == "run: timeout_s is 30.0; it must exceed two beats of 20.0 s"


def test_all_problems_of_keys_and_types_are_reported_at_once(tmp_path: Path) -> None:
    text = changed("sigma_percent = 0.2", "sigma_percent = 0.0").replace("seed = 1", "sed = 1\nseed = -1", 1)
    assert sorted(p.split(":")[0] for p in problems_of(tmp_path, text)) == [
        "measurements.voltage.sigma_percent",
        "sed",
        "seed",
    ]


def test_all_problems_of_areas_meters_and_faults_are_reported_at_once(tmp_path: Path) -> None:
    text = changed("[1, 16, 22, 30]", "[1, 99]").replace("24, 25]", "24]", 1).replace("information", "magic")
    problems = problems_of(tmp_path, text + gross_error("vm@98") + link("area1", "area9"))
    for key in ("strategy:", "areas: bus 25", "measurements.voltage.buses:", "telemetry.gross_error", "faults.link"):
        assert any(p.startswith(key) for p in problems), key


def test_a_penalty_of_admm_out_of_range_is_refused(tmp_path: Path) -> None:
    problems = problems_of(tmp_path, GOOD + "\n[admm]\npenalty = 0\npenelty = 1\n")
    assert any(problem.startswith("admm.penalty: ") for problem in problems)
    assert any(problem.startswith("admm.penelty: unknown key; allowed here: penalty") for problem in problems)
