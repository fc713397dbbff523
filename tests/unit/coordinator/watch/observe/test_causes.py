"""Each fault is named by its one root cause in words, and what follows from it by its effects."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.messages.packing import Incarnation
from agents.peers.clock_skew import Skew
from agents.protocol import quality
from consensus_dsse import simulate
from coordinator.watch.observe.causes import CAUSE_KINDS, WORDS, Cause, Onsets, find_causes, write_lines
from coordinator.watch.observe.notes import read_notes
from coordinator.watch.observe.view import View
from coordinator.watch.observe.view_text import fit_view, format_view
from coordinator.watch.observe.watcher import Watcher
from dsse_core.split_identity import SplitIdentity, SplitUse
from scenarios.files.shipped_files import find_shipped
from tests.support.faulted import FAULTS, SEEN_AT_S, Feeder, run_with, words_of
from tests.support.levels import further
from tests.support.shown_states import published_by

TABLE = Path(__file__).parents[5] / "docs/reference/causes.md"
CERTAIN = [("area killed", "bad meter"), ("link cut", "clock off"), ("wrong file", "liar")]
HIDES = {"gateway dead": {"overload", "undervoltage"}}  # without readings the present of the grid is not known
PAIRS = [pair for pair in itertools.combinations(FAULTS, 2) if "router dead" not in pair]


def test_nothing_is_wrong_in_a_feeder_without_fault(tmp_path: Path):
    feeder = run_with({}, tmp_path)
    assert {area.quality for area in feeder.watcher.look(SEEN_AT_S).areas} == {"good"}
    assert feeder.find_causes() == ()


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_has_one_root_cause_and_all_else_is_its_effect(fault: str, tmp_path: Path):
    feeder = run_with({fault: "area2"}, tmp_path)
    (cause,) = feeder.find_causes()
    assert str(cause).startswith(words_of(fault, "area2"))
    poor = [area.name for area in feeder.watcher.look(SEEN_AT_S).areas if area.quality != "good"]
    itself = {"gone": ("area2",), "router": cause.areas}.get(cause.kind, ())
    named = {name for effect in cause.effects for name in re.findall(r"area\d", effect)}
    assert named == {name for name in poor if name not in itself}


FURTHER = {
    "a clock too far off for any message": (
        {"run.scan_s": 1.0, "faults.clock_error_s": {"area2": 700.0}},
        "the clock of area2 is 700 s ahead since ",
    ),
    "a clock too far behind for any message": (
        {"run.scan_s": 1.0, "faults.clock_error_s": {"area2": -700.0}},
        "the clock of area2 is 700 s behind since ",
    ),
    "a link that works one way": (
        {"faults.link": [{"from": "area1", "to": "area2", "loss": 1.0}]},
        "the agent of area2 has received no message of area1: ",
    ),
    "a false count": (
        {"faults.link": [{"from": "area1", "to": "area2", "lie": {"objective": 100.0}}]},
        "the agent of area2 does not believe area1: it is at the end ",
    ),
}


@pytest.mark.parametrize("fault", FURTHER)
def test_further_faults_have_one_root_cause_each(fault: str):
    changes, words = FURTHER[fault]
    feeder = Feeder(changes)
    feeder.bus.run(SEEN_AT_S)
    (cause,) = feeder.find_causes()
    assert str(cause).startswith(words)


def test_the_first_cause_is_the_first_line_of_a_watcher_and_effects_give_way_in_a_low_terminal(tmp_path: Path):
    feeder = run_with({"area killed": "area2"}, tmp_path)
    view, causes = feeder.watcher.look(SEEN_AT_S), feeder.find_causes()
    high, low = ([line for line, _ in fit_view(view, [], 80, height, causes)] for height in (40, 10))
    assert [*map(str, causes)] == [high[0]] == [low[0]]
    assert "  effects: area1, area3 are degraded" in high
    assert low[1].startswith("run sim")
    assert format_view(view, causes=causes).splitlines()[0] == high[0]


def test_an_area_that_hangs_is_silent_and_its_neighbours_are_effects():
    feeder = Feeder({})
    feeder.bus.run(4.0)
    feeder.bus.pause("area2")
    feeder.bus.run(5.0)
    (cause,) = feeder.find_causes()
    assert (cause.what, cause.areas) == ("the agent of area2 has sent nothing", ("area2",))
    assert (cause.since, cause.effects) == (pytest.approx(3.8), ("area1, area3 are degraded",))


@pytest.mark.parametrize("name", ["ieee33-thesis", "ieee33-load-error", *further(*sorted(find_shipped("shipped")))])
def test_no_shipped_scenario_but_the_liar_ends_with_a_cause(name: str, tmp_path: Path):
    """Strategies that reconcile angles alone leave magnitudes apart, and nobody lies."""
    result = simulate(name, out=tmp_path / "out", plots=False)
    assert [cause.kind for cause in result.causes] == (["mismatch"] if name == "ieee33-liar" else [])


def test_a_branch_beyond_its_rating_is_named_with_its_loading(tmp_path: Path):
    (cause,) = run_with({"overload": "area2"}, tmp_path).find_causes()
    assert str(cause) == "branch 9-10 is at 112.2 % of its rating: shed or transfer load behind it"
    assert (cause.branches, cause.effects) == (("9-10",), ())


def test_a_limit_is_exceeded_since_the_first_of_the_looks_that_have_seen_it_so(tmp_path: Path):
    (cause,) = run_with({"overload": "area2"}, tmp_path).find_causes()
    onsets = Onsets()
    looks = [((), 0.0), ((cause,), 3.0), ((cause,), 5.0), ((), 6.0), ((cause,), 7.0), ((cause,), 4.0)]
    assert [[found.since for found in onsets.date(*look)] for look in looks] == [[], [3.0], [3.0], [], [7.0], [4.0]]
    assert ", seen since 3.0 s: " in str(replace(cause, since=3.0))


def test_areas_that_disagree_are_named_until_the_next_estimate_has_come_to_its_end():
    mismatch, under_way, meter = (Cause(kind, kind, "", "alarm") for kind in ("mismatch", "under way", "bad data"))
    looks = [(under_way,), (mismatch,), (under_way, meter), (mismatch, meter), (under_way,), (meter,), (under_way,)]
    onsets = Onsets()
    assert [[cause.kind for cause in onsets.date(look, at)] for at, look in enumerate(looks)] == [
        ["under way"],
        ["mismatch"],
        ["mismatch", "bad data"],
        ["mismatch", "bad data"],
        ["mismatch"],
        ["bad data"],
        ["under way"],
    ]


def test_a_remark_tells_states_of_the_grid_from_faults_of_the_data_and_is_said_once(tmp_path: Path):
    causes = run_with({"overload": "area2", "bad meter": "area3", "clock off": "area2"}, tmp_path).find_causes()
    assert [(cause.kind, cause.severity, cause.scope) for cause in causes] == [
        ("loading", "alarm", "grid"),
        ("clock", "warning", "data"),
        ("bad data", "warning", "data"),
    ]
    said = [line.strip() for _, lines in write_lines(causes) for line in lines[1:] if "effects" not in line]
    assert said == [causes[0].remark, causes[1].remark]


def test_buses_below_their_limit_are_named_the_lowest_first(tmp_path: Path):
    (cause,) = run_with({"undervoltage": "area2"}, tmp_path).find_causes()
    assert cause.what.startswith("bus 18 is at 0.919")
    assert cause.what.endswith(" p.u., below 0.926 p.u. (and 7 more)")
    assert cause.buses[0] == 18


@pytest.mark.parametrize("faults", [*CERTAIN, *further(*(pair for pair in PAIRS if pair not in CERTAIN))])
def test_of_two_faults_both_are_named_and_nothing_else(faults: tuple[str, str], tmp_path: Path):
    one, other = faults
    causes = run_with({one: "area2", other: "area3"}, tmp_path).find_causes()
    seen = [pair for pair in ((one, "area2"), (other, "area3")) if not HIDES.get(one, set()) & {pair[0]}]
    expected = sorted(seen, key=lambda pair: CAUSE_KINDS.index(FAULTS[pair[0]].kind))
    assert [cause.kind for cause in causes] == [FAULTS[fault].kind for fault, _ in expected]
    assert all(str(cause).startswith(words_of(*pair)) for cause, pair in zip(causes, expected, strict=True))


@pytest.mark.parametrize("fault", [*FAULTS][:-1])
def test_a_dead_router_hides_what_else_is_wrong_and_is_named_alone(fault: str, tmp_path: Path):
    (cause,) = run_with({fault: "area2", "router dead": "area3"}, tmp_path).find_causes()
    assert str(cause).startswith(words_of("router dead", "area3"))


def test_an_area_that_was_gone_before_the_router_is_named_beside_it():
    feeder = Feeder({})
    feeder.bus.run(4.0)
    feeder.bus.kill("area2")
    feeder.bus.run(6.0)
    feeder.bus.stop_router()
    feeder.bus.run(6.0)
    assert [(cause.kind, cause.areas) for cause in feeder.find_causes()] == [
        ("router", ("area1", "area3")),
        ("gone", ("area2",)),
    ]


def test_areas_that_were_gone_before_the_plant_are_not_taken_for_a_dead_router():
    feeder = Feeder({})
    feeder.bus.run(4.0)
    for area in ("area1", "area2", "area3"):
        feeder.bus.kill(area)
    feeder.bus.run(10.0)
    feeder.end_plant()
    feeder.bus.run(1.0)
    assert [(cause.kind, cause.since) for cause in feeder.find_causes()][:3] == [("gone", 4.0)] * 3


def test_a_watcher_without_link_says_so_and_nothing_of_the_areas(tmp_path: Path):
    feeder = run_with({}, tmp_path)
    feeder.watcher.is_linked = False
    assert [cause.kind for cause in feeder.find_causes()] == ["router"]


def test_nobody_is_there_before_the_first_agent():
    assert [str(cause) for cause in find_causes(View("run", (), ()), 0.0)] == [
        "no agent of an area is there: start `dsse agent` for each area file"
    ]


def test_areas_that_disagree_although_both_call_themselves_good_are_named():
    lie = {"from": "area1", "to": "area2", "lie": {"va_deg": 0.5, "both_ways": True}}
    feeder = Feeder({"faults.link": [lie]})
    feeder.bus.run(SEEN_AT_S)
    assert {area.quality for area in feeder.watcher.look(SEEN_AT_S).areas} == {"good"}
    (cause,) = feeder.find_causes()
    assert cause.what == "the estimates of area1 and area2 disagree at bus 6 by 0.5 deg"
    assert (cause.areas, cause.buses) == (("area1", "area2"), (6,))


def test_an_area_that_disagrees_with_several_is_the_liar():
    lies = [{"from": "area1", "to": name, "lie": {"vm_pu": 0.02}} for name in ("area2", "area3")]
    feeder = Feeder({"faults.link": lies})
    feeder.bus.run(SEEN_AT_S)
    cause, *others = feeder.find_causes()
    assert [other.kind for other in others] == ["bad data"]  # a good meter of area3, which the lie contradicts
    assert cause.what.startswith("the estimate of area1 disagrees with area2, area3 at bus 6 by 0.0")


def test_the_clock_that_several_find_wrong_is_the_wrong_one_and_of_two_alone_either():
    def clocks_of(skews: dict[str, str]) -> list[str]:
        watcher = Watcher("run")
        for name, notes in skews.items():
            state = published_by(name, Incarnation(1, 1), notes=(notes,) if notes else (), quality="degraded")
            watcher.take_presence(f"dsse/v3/run/live/area/{name}/1-00000001", True)
            watcher.take_state(state, 0.0)
        return [cause.what for cause in find_causes(watcher.look(0.0), 0.0)]

    note = "the clock of {} is 3 s {} that of this area; one of the two is wrong"
    of_all = {"area1": note.format("area2", "ahead of"), "area3": note.format("area2", "ahead of")}
    assert clocks_of(of_all) == ["the clock of area2 is 3 s ahead"]
    assert clocks_of({"area1": note.format("area2", "behind"), "area2": note.format("area1", "ahead of")}) == [
        "the clocks of area1 and area2 differ by 3 s"
    ]
    assert clocks_of({"area1": note.format("plant", "behind"), "area2": note.format("plant", "behind")}) == [
        "the clock of plant is 3 s behind"
    ]


def test_the_time_of_a_cause_is_known_only_where_it_was_not_there_before(tmp_path: Path):
    feeder = run_with({"bad meter": "area2"}, tmp_path)
    late = Watcher("sim")
    for area, state in feeder.watcher.states.items():
        late.take_presence(f"dsse/v3/sim/live/area/{area}/1-00000001", True)
        late.take_state(state, 0.0)
    assert [cause.since for cause in feeder.find_causes()] != [None]
    assert [cause.since for cause in find_causes(late.look(0.0), 0.0)] == [None]


def test_every_note_that_names_a_cause_is_read():
    new, old = SplitIdentity("2" * 16, 2e9), SplitIdentity("1" * 16, 1e9)
    findings = {
        "clock": quality.find_skewed_clocks({"area2": Skew(3.0, 0.1)}),
        "future": quality.find_rejected_clocks({"area2": 700.0}),
        "contradiction": quality.find_contradictions({"area2": "base is 1 here and 2 there; correct one of them"}),
        "file": quality.find_other_splits([SplitUse(new), SplitUse(old, ("area2",))], "area1"),
        "map": quality.find_mistaken_gateways({"plant": "sign"}),
        "impostor": quality.find_far_scans({"area2": 99}),
        "unreadable": quality.find_unreadable_payloads({"area2": "z: not finite"}),
    }
    for kind, found in findings.items():
        (finding,) = found
        (noted,) = read_notes((finding.note,), (), None, 0.0)
        assert (noted.kind, noted.parts["other"]) == (kind, "plant" if kind == "map" else "area2")


@pytest.mark.parametrize(("kind", "n_cause"), [("wrong status", 1), ("unknown status", 2)])
def test_a_switch_of_wrong_or_unknown_status_is_named_and_has_its_branch_as_its_place(kind: str, n_cause: int):
    found = {
        "wrong status": quality.find_doubtful_switches(("18-33",), {}),
        "unknown status": quality.find_unknown_statuses({"18-33": "gateway a reads open, gateway b reads closed"}),
    }
    (finding,) = found[kind]
    watcher = Watcher("run")
    for name in ("area1", "area2"):
        state = published_by(name, Incarnation(1, 1), notes=(finding.note,), quality=finding.quality)
        watcher.take_presence(f"dsse/v3/run/live/area/{name}/1-00000001", True)
        watcher.take_state(state, 0.0)
    causes = find_causes(watcher.look(0.0), 0.0)
    assert [(cause.kind, cause.branches) for cause in causes] == [(kind, ("18-33",))] * n_cause
    assert causes[0].mark == f"18-33: {kind}"
    assert causes[0].effects != ()


WORD = st.text(max_size=12) | st.sampled_from(["area1", "area2", "this area", "telemetry", "nan", "1e999", "-1", "{x}"])
FORGED = [
    "boundary mismatch with {0} at bus 6: its final voltage differs by {1} p.u. and {2} deg; {1}",
    "{0} is not believed: {1}",
    "5 of 3 areas are counted: {0} says false things, or passes them on",
    "the clock of {0} is {1} s ahead of that of this area; {2}",
    "{0} is rejected, from 700 s in the future: {1}",
    "{0} is rejected: {1}",
    "the file of {0} is older{1}: {2}",
    "all power readings of gateway {0} look wrong, {1}: {2}",
    "not observable: no reading of this scan determines buses {0}",
    "no estimate: {0}",
    "{0} % of the readings of this area are overdue or missing, {1}",
    "readings contradict each other ({0}); {1} stands out",
    "{0} is removed, and the readings do not tell it from {1}: check {2}",
    "voltages of 3 buses are outside {0}, the farthest is {1} p.u. at bus {2}",
    "payloads of {0} are rejected, {1}",
    "switch@{0} counts the other way, {1}",
    "status of switch {0} unknown: {1}; it stays as it was",
]
NOTE = st.builds(lambda form, *words: form.format(*words), st.sampled_from(FORGED), WORD, WORD, WORD)


@given(st.dictionaries(st.sampled_from(["area1", "area2", "x\x1b[0m"]), st.lists(NOTE | st.text(), max_size=5)))
def test_notes_that_a_hostile_area_forges_break_nothing_and_are_shown_as_text(notes: dict[str, list[str]]):
    watcher = Watcher("run")
    for name, said in notes.items():
        state = published_by(name, Incarnation(1, 1), notes=tuple(said), quality="degraded", removed=("{}", "vm@9"))
        watcher.take_presence(f"dsse/v3/run/live/area/{name}/1-00000001", True)
        watcher.take_state(state, 0.0)
    causes = find_causes(watcher.look(0.0), 0.0)
    assert bool(causes) == bool(notes) or not notes
    assert all(text.isprintable() for cause in causes for text in (str(cause), *cause.effects))
    assert all({*cause.areas} <= notes.keys() for cause in causes)


def test_the_words_of_the_docs_are_those_of_the_code():
    rows = re.findall(r"^\| `([^`]+)` \| (.*?) \| (.*?) \| (alarm|warning) \|$", TABLE.read_text(), re.M)
    assert rows == [(kind, *words[:3]) for kind, words in WORDS.items()]
