"""What a watcher makes of presence and states, without a bus."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agents.messages.keys import check_run_id, live_key
from agents.messages.packing import Incarnation
from coordinator.watch.observe.view import OVER_S, AreaView
from coordinator.watch.observe.view_text import format_view
from coordinator.watch.observe.watcher import Watcher
from dsse_core.errors import InvalidInputError
from tests.support.shown_states import a_state, published_by

ONE, OTHER = (live_key("run", "area", "area1", Incarnation(start, 1)) for start in (1, 2))


def seen(watcher: Watcher, now: float) -> AreaView:
    return next(area for area in watcher.look(now).areas if area.name == "area1")


def test_the_last_state_of_an_area_that_is_gone_is_stale_and_its_ages_go_on():
    watcher = Watcher("run")
    watcher.take_presence(ONE, True)
    watcher.take_state(a_state(), 5.0)
    assert seen(watcher, 5.0).quality == "good"
    watcher.take_presence(ONE, False)
    gone = seen(watcher, 65.0)
    assert (gone.quality, gone.state, gone.telemetry_age_s, gone.ages_s) == ("stale", "gone", 60.1, {"area2": 60.2})


def test_an_area_that_is_there_and_silent_for_long_is_stale_whatever_it_published():
    watcher = Watcher("run")
    watcher.take_presence(ONE, True)
    for at in (5.0, 5.2, 5.4):
        watcher.take_state(a_state(), at)
    assert (seen(watcher, 5.4 + 0.9 * OVER_S).quality, seen(watcher, 5.4 + 1.1 * OVER_S).quality) == ("good", "stale")
    assert seen(watcher, 8.4).age_s == 3.0
    assert seen(watcher, 8.4).state == "silent"
    assert "has sent nothing for 3.0 s (it said good)" in format_view(watcher.look(8.4))


def test_an_area_with_a_slow_heartbeat_is_not_silent_between_two_of_its_messages():
    watcher = Watcher("run")
    watcher.take_presence(ONE, True)
    for at in (0.0, 10.0):
        watcher.take_state(a_state(), at)
    assert (seen(watcher, 29.0).quality, seen(watcher, 41.0).quality) == ("good", "stale")


def test_what_never_was_an_estimate_does_not_become_a_stale_one():
    watcher = Watcher("run")
    watcher.take_state(a_state(quality="none"), 5.0)
    assert seen(watcher, 6.0).quality == "none"


def test_a_leave_message_belongs_to_one_incarnation_so_that_a_later_death_is_reported():
    watcher = Watcher("run")
    watcher.take_presence(ONE, True)
    watcher.take_leave(ONE, "SIGTERM")
    assert seen_state(watcher) == "left"
    watcher.take_presence(OTHER, True)
    watcher.take_presence(OTHER, False)
    assert seen_state(watcher) == "gone"


def test_the_leave_message_of_a_former_incarnation_does_not_outlast_the_next_one():
    watcher = Watcher("run")
    watcher.take_presence(ONE, True)
    watcher.take_presence(OTHER, True)
    watcher.take_leave(ONE, "SIGTERM")
    watcher.take_presence(OTHER, False)
    assert seen_state(watcher) == "gone"


def seen_state(watcher: Watcher) -> str:
    watcher.take_state(a_state(), 5.0)
    return seen(watcher, 5.0).state


def test_an_incarnation_whose_clock_was_set_back_is_shown_once_the_newer_one_was_silent_for_long():
    watcher = Watcher("run")
    watcher.take_state(published_by("area1", Incarnation(2, 1), messages=1), 0.0)
    watcher.take_state(published_by("area1", Incarnation(1, 1), messages=2), 0.9 * OVER_S)
    assert seen(watcher, OVER_S).messages == 1
    watcher.take_state(published_by("area1", Incarnation(1, 1), messages=2), 1.1 * OVER_S)
    assert seen(watcher, 2 * OVER_S).messages == 2


def test_mismatches_are_the_largest_to_a_neighbour_at_a_bus_that_both_show():
    watcher = Watcher("run")
    incarnation, neighbours = Incarnation(1, 1), {"area2": (1, 1), "area3": (1, 1)}
    watcher.take_state(published_by("area1", incarnation, sent=neighbours), 0.0)
    assert seen(watcher, 0.0).mismatch_vm_pu is None
    watcher.take_state(published_by("area2", incarnation, vm=(1.01,)), 0.0)
    watcher.take_state(published_by("area3", incarnation, vm=(0.97,)), 0.0)
    assert seen(watcher, 0.0).mismatch_vm_pu == pytest.approx(0.03)


@pytest.mark.parametrize("relative", ["area1", "area2"])
def test_relative_angles_have_no_mismatch(relative: str):
    watcher = Watcher("run")
    for area, va in (("area1", 0.0), ("area2", 2.0)):
        sent = {"area2": (1, 1)} if area == "area1" else {}
        changes = {"sent": sent, "va": (va,), "vm": (1.0 + va / 100,), "referenced": area != relative}
        watcher.take_state(published_by(area, Incarnation(1, 1), **changes), 0.0)
    area = seen(watcher, 0.0)
    assert (area.mismatch_vm_pu, area.mismatch_va_deg) == (pytest.approx(0.02), None)


def test_states_of_different_scans_have_no_mismatch():
    watcher = Watcher("run")
    watcher.take_state(published_by("area1", Incarnation(1, 1), sent={"area2": (1, 1)}), 0.0)
    state = published_by("area2", Incarnation(1, 1), vm=(1.02,), va=(2.0,))
    watcher.take_state(replace(state, header=replace(state.header, scan=2)), 0.0)
    area = seen(watcher, 0.0)
    assert (area.mismatch_vm_pu, area.mismatch_va_deg) == (None, None)


@pytest.mark.parametrize("name", ["a/*", "**", "", "IEEE33"])
def test_a_run_to_watch_is_a_name_and_no_pattern(name: str):
    with pytest.raises(InvalidInputError, match="may only contain"):
        check_run_id(name)


def test_what_an_area_says_is_shown_and_never_obeyed():
    watcher = Watcher("[/run]")
    hostile = "[/nope]\x1b]0;owned\x07\nconsensus :smile: [bold red]"
    for area in ("area1", "[/link]\x9b2J"):
        state = published_by(area, Incarnation(1, 1), notes=(hostile,), quality="\x1b[8m[/x]")
        watcher.take_state(replace(state, header=replace(state.header, run="[/run]")), 0.0)
    table = format_view(watcher.look(0.0))
    assert table.replace("\n", "").isprintable()
    text = "".join(table.replace("│", "").split())  # cells may be broken into lines
    for part in ("run[/run]", r"[/link]\x9b2J", r"[/nope]\x1b]0;owned", ":smile:", r"\x1b[8m[/x]"):
        assert part in text


def test_one_area_does_not_fill_the_terminal():
    watcher = Watcher("run")
    notes = tuple(f"{k} " + "x" * 900 for k in range(50))
    watcher.take_state(a_state(notes=notes, telemetry_age=1e300), 0.0)
    table = format_view(watcher.look(0.0))
    assert "and 47 notes more" in table
    assert len(table.splitlines()) < 20


def test_an_area_and_a_plant_that_run_twice_are_named_with_their_incarnations_as_long_as_they_do():
    watcher = Watcher("run")
    for key in (OTHER, ONE, *(live_key("run", "plant", "plant", Incarnation(start, 1)) for start in (3, 4))):
        watcher.take_presence(key, True)
    one, other = watcher.look(0.0).duplicates
    assert "2 agents of area area1 publish at once: 1-00000001 and 2-00000001" in one
    assert "2 plants publish at once" in other
    assert other in format_view(watcher.look(0.0))
    watcher.take_presence(ONE, False)
    assert watcher.look(0.0).duplicates == (other,)


def test_areas_of_another_wire_version_are_named_instead_of_nothing_being_shown():
    watcher = Watcher("run")
    for version, name in (("v1", "area1"), ("v1", "area2"), ("v7", "area3"), ("strange", "area4")):
        watcher.take_presence(f"dsse/{version}/run/live/area/{name}/1-00000001", True)
    view = watcher.look(0.0)
    assert not watcher.is_whole()
    assert view.areas == ()
    assert view.other_versions[1:] == (
        "area area1, area area2 speak wire version 1, this is version 3: upgrade the other side",
        "area area3 speaks wire version 7, this is version 3: upgrade this program",
    )
    assert "speak wire version 1, this is version 3" in format_view(view)
    watcher.take_presence("dsse/v7/run/live/area/area3/1-00000001", False)
    assert len(watcher.look(0.0).other_versions) == 2
