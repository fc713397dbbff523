"""Every mistake in a scenario file is rejected, naming key, what was found and what is allowed; all at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from agents.messages.keys import default_run_id
from dsse_core.errors import InvalidInputError
from scenarios.files.shipped_files import find_shipped
from scenarios.scenario import load_scenario
from tests.support.scenario_mistakes import GOOD, link, problems_of, the_only


def changed(old: str, new: str) -> str:
    assert old in GOOD
    return GOOD.replace(old, new, 1)


def test_an_unknown_key_is_rejected_with_the_allowed_ones_and_the_closest(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("noise = true", "noise = true\nnois = true")))
    allowed = "source, ticks, leader, file, noise, gross_error"
    assert problem == f"telemetry.nois: unknown key; allowed here: {allowed}; did you mean 'noise'?"


def test_an_unknown_key_at_the_top_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("seed = 1", "seeed = 1")))
    assert problem.startswith("seeed: unknown key; allowed here: version, name, description, seed, network,")


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("loss", "'faults.loss' or 'faults.burst.loss'"),
        ("scan_s", "'run.scan_s'"),
        ("voltage", "'measurements.voltage'"),
        ("sigma_percnt", "'measurements.voltage.sigma_percent' or"),
        ("seeed", "'seed'"),
    ],
)
def test_a_key_of_another_table_is_found_by_its_last_part(typed: str, meant: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        load_scenario("ieee33", changes={typed: 1})
    assert f"; did you mean {meant}" in the_only(caught.value.problems)


def test_an_unknown_key_inside_a_named_area_is_rejected_with_what_an_area_allows(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("[areas.area2]", "[areas.area2]\nbusses = [1]")))
    assert problem == (
        "areas.area2.busses: unknown key; allowed here: buses, slack_bus, slack_vm_pu, holds; did you mean 'buses'?"
    )


def test_an_unknown_key_inside_a_list_of_tables_is_rejected_with_its_position(tmp_path: Path) -> None:
    text = GOOD + '\n[[faults.link]]\nfrom = "area1"\nto = "area2"\nloss = 0.1\ndelay = 1\n'
    assert the_only(problems_of(tmp_path, text)) == (
        "faults.link[1].delay: unknown key; allowed here: from, to, loss, burst, delay_ms, jitter_ms, duplicate, "
        "corrupt, load, lie; did you mean 'delay_ms'?"
    )


def test_a_position_in_a_list_is_not_left_to_be_guessed() -> None:
    with pytest.raises(InvalidInputError) as caught:
        load_scenario("ieee33", changes={"areas.area2.buses": [7, "y"]})
    *_, problem, note = str(caught.value).splitlines()
    assert problem.endswith("areas.area2.buses[2]: must be a valid integer, found 'y'")
    assert note == "(items of lists count from 1)"
    with pytest.raises(InvalidInputError) as caught:
        load_scenario("ieee33", changes={"seed": -1})
    assert "count from" not in str(caught.value)


@pytest.mark.parametrize(
    "changes", [{"areas": {300 * "a": {"buses": [*range(1, 34)]}}}, {"name": 300 * "a"}, {"name": ""}]
)
def test_a_name_of_300_letters_does_not_pass_the_check_to_fail_later(changes: dict[str, object]) -> None:
    with pytest.raises(InvalidInputError, match=r"must have at (most 64|least 1) character"):
        load_scenario("ieee33", changes=changes)


def test_a_file_with_a_name_of_200_letters_has_a_run_of_64(tmp_path: Path) -> None:
    path = tmp_path / (200 * "a" + ".toml")
    path.write_text(GOOD, encoding="utf-8")
    assert default_run_id(load_scenario(path).name) == 64 * "a"


def test_a_missing_key_is_named_with_its_meaning(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('network = "ieee33"', "")))
    assert (
        problem == "network: missing; name of a shipped network, or path of a .toml or .json file relative to this file"
    )


def test_an_estimated_tap_needs_voltmeters_at_both_ends(tmp_path: Path) -> None:
    network = find_shipped("cases")["ieee33"].read_text(encoding="utf-8")
    estimated = network.replace("from = 21, to = 22,", "from = 21, to = 22, estimate_tap = true,")
    (tmp_path / "tapped.toml").write_text(estimated, encoding="utf-8")
    assert the_only(problems_of(tmp_path, changed('"ieee33"', '"tapped.toml"'))) == (
        "network: branch 21-22 has estimate_tap, which needs a voltmeter at both ends; "
        "add a meter of voltage at bus 21, or leave estimate_tap out"
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


def test_an_unknown_shipped_scenario_is_rejected_with_the_names_and_the_closest() -> None:
    with pytest.raises(
        InvalidInputError, match=r"shipped: case33bw, ieee123, ieee13, ieee33, .*did you mean 'ieee33-lossy'"
    ):
        load_scenario("ieee33-losy")


def test_another_version_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("version = 1", "version = 2")))
    assert problem.startswith("version: must be 1, found 2")


def test_a_negative_seed_is_rejected(tmp_path: Path) -> None:
    assert the_only(problems_of(tmp_path, changed("seed = 1", "seed = -1"))).startswith("seed: must be greater")


def test_a_text_in_place_of_a_number_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("floor_kva = 1.0", 'floor_kva = "1"')))
    assert problem.startswith("measurements.floor_kva: must be a valid number, found '1'")


def test_an_infinite_number_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("floor_kva = 1.0", "floor_kva = inf")))
    assert problem.startswith("measurements.floor_kva: must be a finite number")


def test_a_whole_number_is_good_enough_for_a_quantity(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(changed("floor_kva = 1.0", "floor_kva = 1"), encoding="utf-8")
    assert load_scenario(path).meters


def test_an_unknown_strategy_is_rejected_with_the_allowed_ones(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('"information"', '"magic"')))
    assert problem == "strategy: unknown strategy 'magic'; allowed: angle-offset, information"


def test_a_strategy_that_the_caller_knows_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(changed('"information"', '"admm"'), encoding="utf-8")
    assert load_scenario(path, strategies=("angle-offset", "admm")).strategy == "admm"


def test_an_unknown_network_is_rejected_with_those_that_are_shipped(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('network = "ieee33"', 'network = "ieee34"')))
    assert "shipped: case33bw, ieee123, ieee13, ieee33, industrial13; did you mean 'ieee33'?" in problem
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
def test_a_sigma_that_is_not_positive_in_the_squares_is_rejected(tmp_path: Path, sigma: str) -> None:
    problem = the_only(problems_of(tmp_path, changed("sigma_percent = 0.2", f"sigma_percent = {sigma}")))
    assert problem.startswith(
        "measurements.voltage.sigma_percent: must be greater than or equal to 0.000000001, found "
    )


@pytest.mark.parametrize(("sigmas", "found"), [("", "neither"), (", sigma_percent = 1.0, sigma_pu = 0.1", "both")])
def test_two_sigmas_or_none_are_rejected(tmp_path: Path, sigmas: str, found: str) -> None:
    problem = the_only(problems_of(tmp_path, changed(", sigma_percent = 0.2", sigmas)))
    assert problem.startswith("measurements.voltage: give exactly one of sigma_percent")
    assert problem.endswith(f"found {found}")


def test_a_scenario_without_any_meter_is_rejected(tmp_path: Path) -> None:
    text = "\n".join(line for line in GOOD.splitlines() if not line.startswith(("voltage", "flow", "injection")))
    assert the_only(problems_of(tmp_path, text)).startswith("measurements: there is no meter")


def test_a_selection_that_is_neither_all_nor_a_list_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('branches = "all"', 'branches = "some"')))
    assert problem.startswith('measurements.flow.branches: must be "all" or a list of branch ids')


def test_half_a_local_slack_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("[areas.area2]", "[areas.area2]\nslack_bus = 16")))
    assert problem == "areas.area2: slack_bus and slack_vm_pu belong together; give both or none"


def test_a_local_slack_outside_its_area_is_rejected(tmp_path: Path) -> None:
    text = changed("[areas.area2]", "[areas.area2]\nslack_bus = 1\nslack_vm_pu = 1.0")
    assert the_only(problems_of(tmp_path, text)) == "areas: area area2: slack_bus 1 is not one of its buses"


def test_an_area_name_with_a_blank_or_a_capital_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("[areas.area2]", '[areas."Area 2"]')))
    assert problem.startswith("areas.Area 2: must match pattern")


def test_a_bus_in_no_area_is_named(tmp_path: Path) -> None:
    problems = problems_of(tmp_path, changed("24, 25]", "24]"))
    assert "areas: bus 25 is in no area; add it to the buses of one" in problems


def test_an_area_in_pieces_is_named(tmp_path: Path) -> None:
    problems = problems_of(tmp_path, changed("buses = [30, 31,", "buses = [20, 30, 31,"))
    assert any("area area3 is not connected" in p for p in problems)


def test_a_branch_that_two_areas_list_is_named(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed("27, 26, 6]", "27, 26, 6, 5]")))
    assert problem == (
        "areas: areas area1, area3 all list both ends of branch 5-6; leave bus 5 or 6 out of all but one of them"
    )


def test_meters_at_unknown_and_repeated_places_are_named_with_their_keys(tmp_path: Path) -> None:
    text = changed("[1, 16, 22, 30]", "[1, 99, 22, 22]").replace('branches = "all"', 'branches = ["1-2", "2-1"]')
    problems = problems_of(tmp_path, text)
    assert problems[0] == "measurements.voltage.buses: bus 22 is listed twice; keep one"
    assert problems[1] == "measurements.voltage.buses: bus 99 is not in network 'ieee33'"
    assert problems[2].startswith("measurements.flow.branches: branch '2-1' is not in network 'ieee33'")
    assert len(problems) == 3


def test_a_meter_on_a_branch_out_of_service_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, changed('branches = "all"', 'branches = ["1-2", "25-29"]')))
    assert problem == ("measurements.flow.branches: branch '25-29' is out of service; remove it from the list")


def gross_error(meter: str) -> str:
    return f'\n[[telemetry.gross_error]]\nmeter = "{meter}"\nsigmas = 20.0\n'


def test_a_gross_error_of_an_unknown_meter_is_rejected_with_those_beside_it(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + gross_error("p_flow@4:3-4")))
    assert problem.startswith("telemetry.gross_error[1].meter: 'p_flow@4:3-4' is no meter of this scenario")
    assert problem.partition("; ")[2].startswith("beside it stand p_flow@3:3-4, q_flow@3:3-4")


def test_a_gross_error_of_an_exact_zero_injection_is_rejected(tmp_path: Path) -> None:
    text = find_shipped("shipped")["industrial13"].read_text(encoding="utf-8") + gross_error("p_injection@2")
    assert "p_injection@2 is an exact zero injection" in the_only(problems_of(tmp_path, text))


@pytest.mark.parametrize(
    ("listen", "found"),
    [
        ("127.0.0.1", "'127.0.0.1' is no endpoint, tcp/HOST:PORT"),
        ("tcp/127.0.0.1:65536", "the port is '65536'"),
        ("tls/127.0.0.1:0", "a scenario says tcp/HOST:PORT"),
        ("tcp/127.0.0.1:0#iface=lo", "the port is '0#iface=lo'"),
    ],
)
def test_a_listening_address_that_is_no_endpoint_is_rejected(tmp_path: Path, listen: str, found: str) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + f'\n[transport]\nlisten = "{listen}"\n'))
    assert problem.startswith("transport.listen: ")
    assert found in problem


def test_a_time_limit_shorter_than_two_heartbeats_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + "\n[run]\nbeat_s = 20.0\n"))
    assert problem == "run: timeout_s is 30.0; it must exceed two heartbeats of 20.0 s"


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


def test_a_penalty_of_admm_out_of_range_is_rejected(tmp_path: Path) -> None:
    problems = problems_of(tmp_path, GOOD + "\n[admm]\npenalty = 0\npenelty = 1\n")
    assert any(problem.startswith("admm.penalty: ") for problem in problems)
    assert any(problem.startswith("admm.penelty: unknown key; allowed here: penalty") for problem in problems)
