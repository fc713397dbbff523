"""Every mistake in the faults of a scenario is rejected, naming key, what was found and what is allowed."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from dsse_core.link_faults import LinkFaults
from scenarios.faults.schedule import FaultSchedule
from scenarios.scenario import load_scenario
from tests.support.scenario_mistakes import GOOD, link, problems_of, the_only


@pytest.mark.parametrize("loss", ["-0.1", "1.5"])
def test_a_loss_that_is_no_probability_is_rejected(tmp_path: Path, loss: str) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + f"\n[faults]\nloss = {loss}\n"))
    assert problem.startswith("faults.loss: must be ")
    assert f"found {loss}" in problem


def test_a_load_error_of_an_unknown_area_is_rejected(tmp_path: Path) -> None:
    text = GOOD + "\n[faults.load_error.area9]\np_mw = 0.3\nq_mvar = 0.3\n"
    assert the_only(problems_of(tmp_path, text)) == (
        "faults.load_error.area9: there is no area 'area9'; areas: area1, area2, area3; 'all' means each"
    )


def test_a_load_error_without_its_reactive_part_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + "\n[faults.load_error.area1]\np_mw = 0.3\n"))
    assert problem.startswith("faults.load_error.area1.q_mvar: missing;")


def test_a_link_of_an_unknown_area_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + link("area1", "area9")))
    assert problem == "faults.link[1].to: there is no area 'area9'; areas: area1, area2, area3"


def test_a_link_between_areas_that_are_not_neighbours_is_rejected_with_the_links(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + link("area2", "area3")))
    assert problem.startswith("faults.link[1]: area2 and area3 are not neighbours; links: area2 to area1,")


def test_a_link_that_is_given_twice_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + 2 * link("area1", "area2")))
    assert problem == "faults.link[2]: the link from area1 to area2 is given twice; keep one"


def events(*lines: str) -> str:
    return "\n[faults]\nevents = [" + ", ".join(f"{{ {line} }}" for line in lines) + "]\n"


def test_every_event_that_cannot_happen_is_rejected_with_its_number(tmp_path: Path) -> None:
    text = GOOD + events(
        'at_s = 1, kill = "area9"',
        'at_s = 1, cut = ["area2", "area3"], for_s = 1',
        'at_s = 1, cut = ["area2", "plant"], for_s = 1',
        'at_s = 29, pause = "router", for_s = 1',
    )
    problems = problems_of(tmp_path, text)
    assert problems == (
        "faults.events[1].kill: there is no 'area9'; allowed: area1, area2, area3, plant, router",
        "faults.events[3].cut: there is no 'plant'; allowed: area1, area2, area3",
        "faults.events[4]: is over 30 s after the start, but run.timeout_s is 30; raise timeout_s or let it happen "
        "earlier",
        "faults.events[2].cut: area2 and area3 are not neighbours; links: area2 to area1, area3 to area1, "
        "area1 to area2, area1 to area3",
    )


def test_events_that_meet_what_is_dead_frozen_silent_or_cut_already_are_rejected(tmp_path: Path) -> None:
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
        "faults.events[3].pause: area1 is dead by then, killed by faults.events[2]; restart it before, or remove one "
        "of the two",
        "faults.events[6].silent: falls into faults.events[5], pause plant until 4 s; let it happen earlier or later",
        "faults.events[8].cut: falls into faults.events[7], cut area1 and area2 until 3 s; let it happen earlier or "
        "later",
    )


def test_a_switch_event_names_a_switch_of_the_network_and_its_status_from_then_on(tmp_path: Path) -> None:
    text = GOOD + events('at_s = 1, switch = "18-33", to = "closed"')
    assert the_only(problems_of(tmp_path, text)) == (
        "faults.events[1].switch: there is no switch '18-33'; switches: none; a branch becomes one by `switch = true` "
        "in the network file"
    )
    text = GOOD + events('at_s = 1, switch = "18-33"', 'at_s = 1, kill = "area1", to = "open"')
    first, second = problems_of(tmp_path, text)
    assert 'switch needs its status from then on: to = "open" or "closed"' in first
    assert "kill takes no to, which are of a switch" in second


def test_an_event_may_begin_when_the_one_before_it_ends(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(GOOD + events('at_s = 1, pause = "area1", for_s = 1', 'at_s = 2, pause = "area1", for_s = 1'))
    steps = FaultSchedule.of(load_scenario(path).faults.events).steps
    assert [(step.at_s, step.kind) for step in steps] == [(1, "pause"), (2, "resume"), (2, "pause"), (3, "resume")]


def test_the_second_router_can_be_named_where_there_is_one(tmp_path: Path) -> None:
    happens = events('at_s = 1, kill = "router2"', 'at_s = 2, restart = "router2"')
    assert the_only(problems_of(tmp_path, GOOD + events('at_s = 1, kill = "router2"'))) == (
        "faults.events[1].kill: there is no 'router2' with transport.routers = 1; allowed: area1, area2, area3, plant, "
        "router"
    )
    path = tmp_path / "mine.toml"
    path.write_text(GOOD + "[transport]\nrouters = 2\n" + happens)
    assert [event.names for event in load_scenario(path).faults.events] == [("router2",), ("router2",)]


def test_there_is_no_router_to_kill_where_neighbours_link_directly(tmp_path: Path) -> None:
    text = GOOD + '[transport]\nkind = "neighbours"\n' + events('at_s = 1, restart = "router"')
    assert the_only(problems_of(tmp_path, text)) == (
        "faults.events[1].restart: there is no 'router' with transport.kind = \"neighbours\"; allowed: area1, area2, "
        "area3, plant"
    )


@pytest.mark.parametrize(
    ("event", "expected"),
    [
        ("at_s = 1", "give exactly one of kill, restart, pause, cut, silent and switch, found none"),
        ('at_s = 1, kill = "area1", pause = "area2"', "found kill and pause"),
        ('at_s = 1, pause = "area1"', "pause lasts; say how long with for_s"),
        ('at_s = 1, restart = "area1", for_s = 2', "restart happens in a moment; remove for_s"),
        ('at_s = 1, cut = ["area1"], for_s = 2', "cut must name two neighbouring areas"),
    ],
)
def test_an_event_is_exactly_one_thing_that_lasts_or_does_not(tmp_path: Path, event: str, expected: str) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + events(event)))
    assert problem.startswith("faults.events[1]: ")
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


def test_a_lie_reported_both_ways_is_taken_back_in_the_other_direction() -> None:
    """Who believes y' = scale y + offset receives in return (y' - offset) / scale of what it says."""
    lie = {"p_mw": 0.3, "vm_pu": 0.02, "va_deg": -1.0, "scale": 1.25, "both_ways": True}
    links = load_scenario(
        "ieee33", changes={"faults.link": [{"from": "area1", "to": "area2", "lie": lie}]}
    ).faults.links
    there, back = links["area1", "area2"], links["area2", "area1"]
    assert there.lie_scale * back.lie_scale == 1.0
    for offset, taken_back in zip(there.lie_offset, back.lie_offset, strict=True):
        assert back.lie_scale * offset + taken_back == pytest.approx(0.0, abs=1e-15)
    assert links["area1", "area3"] == LinkFaults()


def test_a_lie_both_ways_beside_a_lie_of_the_other_direction_is_rejected(tmp_path: Path) -> None:
    text = GOOD + link("area1", "area2") + "lie = { vm_pu = 0.1, both_ways = true }\n"
    text += link("area2", "area1") + "lie = { va_deg = 1.0 }\n"
    assert the_only(problems_of(tmp_path, text)) == (
        "faults.link[1].lie.both_ways: faults.link[2] gives the other direction a lie of its own; remove one of the two"
    )


def test_a_band_of_voltages_that_is_empty_is_rejected(tmp_path: Path) -> None:
    problem = the_only(problems_of(tmp_path, GOOD + "\n[quality]\nlowest_vm_pu = 1.6\n"))
    assert "lowest_vm_pu is 1.6; it must be below highest_vm_pu, 1.5" in problem


BANK_BEHIND_SWITCHES = """
name = "bank"
data_source = "made up"
base_mva = 1.0
bus = [
    { id = 1, base_kv = 12.47, phases = "abc" }, { id = 2, base_kv = 12.47, phases = "abc" },
    { id = 3, base_kv = 0.48, phases = "abc" },
]
source = [{ bus = 1, kind = "slack", vm_pu = 1.0 }]
load = [{ bus = 3, phases = "ab,bc,ca", p_kw = [60.0, 20.0, 40.0], q_kvar = [10.0, 5.0, 20.0] }]
branch = [
    { id = "a", from = 1, to = 2, phases = "a", r_ohm = 1.0, x_ohm = 1.0, switch = true },
    { id = "b", from = 1, to = 2, phases = "b", r_ohm = 1.0, x_ohm = 1.0, switch = true },
    { id = "c", from = 1, to = 2, phases = "c", r_ohm = 1.0, x_ohm = 1.0, switch = true },
]
[[transformer]]
id = "yd"
kva = 300.0
r_percent = 1.0
x_percent = 4.0
windings = [
    { bus = 2, phases = "abc", kv = 12.47, connection = "grounded wye" },
    { bus = 3, phases = "abc", kv = 0.48, connection = "delta" },
]
"""


def test_an_event_that_leaves_a_winding_without_voltage_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "bank.toml").write_text(BANK_BEHIND_SWITCHES, encoding="utf-8")
    text = """
version = 1
description = "a bank"
network = "bank.toml"
areas = { area1 = { buses = [1, 2, 3] } }
[measurements]
voltage = { buses = [1, 2, 3], sigma_percent = 0.5 }
injection = { buses = "all", sigma_percent = 10.0 }
"""
    later, sooner = 'at_s = 2, switch = "c", to = "open"', 'at_s = 1, switch = "b", to = "open"'
    assert the_only(problems_of(tmp_path, text + events(later, sooner))) == (
        "faults.events[1].switch: with c open, nothing joins phases of bus 3 to the source or to ground; "
        "ground a winding of their bank, or feed all its phases"
    )
