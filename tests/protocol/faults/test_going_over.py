"""All areas go over to the files of a new split at one scan, whatever happens meanwhile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agents.protocol.quality import GOOD
from scenarios.telemetry import make_telemetry
from tests.support.going_over import LONGEST_GAP_S, NEXT, OLD, GoingOver, files_of
from tests.support.levels import further
from tests.support.simulated_bus import SimulatedBus

WHAT = ("other cuts", "other network")
AREAS = tuple(area.name for area in OLD.partition.areas)
HUB, *OTHERS = AREAS  # the first area decides


def at_rest(what: str = "other cuts", *offered: str, loss: float = 0.0) -> GoingOver:
    """After one scan all areas hold the old files, and those ``offered`` the next ones beside them."""
    system = GoingOver(what, loss=loss)
    system.scan()
    assert {state.quality for state in system.bus.states.values()} == {GOOD}
    for name in offered:
        system.bus.offer(name, system.file(name))
    return system


def assert_over(system: GoingOver, *, scans: int = 1) -> None:
    """After ``scans`` more all areas are good on the next split, and no state has ever been good that is wrong."""
    system.scan(scans)
    assert system.is_over(), {name: (s.quality, str(s.split), s.notes) for name, s in system.bus.states.items()}
    assert not system.wrong


def assert_stays(system: GoingOver, *, scans: int = 2, note: str = "") -> None:
    """All areas stay on the old split and good; each has a remark that begins with ``note``."""
    system.scan(scans)
    for state in system.bus.states.values():
        assert (state.quality, state.split) == (GOOD, system.old[0].identity), state.notes
        assert any(remark.startswith(note) for remark in state.notes) or not note, state.notes


@pytest.mark.parametrize(("what", "loss"), [("other cuts", 0.3), ("other network", 0.0)])
def test_all_areas_go_over_with_the_scan_after_the_one_in_which_all_hold_the_next_file(what: str, loss: float):
    system = at_rest(what, loss=loss)
    for k, name in enumerate(AREAS):
        assert {state.split for state in system.bus.states.values()} == {system.old[0].identity}
        system.bus.offer(name, system.file(name))
        system.scan()
        if k < len(AREAS) - 1:
            remark = f"the file of the next {system.split} lies ready in {k + 1} of {len(AREAS)} areas"
            assert all(remark in state.notes for state in system.bus.states.values())
            holders = {area for area, state in system.bus.states.items() if state.next_split == system.split}
            assert holders == {*AREAS[: k + 1]}
    assert_over(system)
    assert system.longest_gap_s <= LONGEST_GAP_S


@pytest.mark.parametrize("name", [HUB, *further(AREAS[-1])])
def test_an_area_that_dies_after_the_final_verdict_follows_when_it_is_back_with_both_files(name: str):
    system = at_rest("other cuts", *AREAS)
    system.scan()
    system.kill(name)
    system.scan(4)
    others = [state for area, state in system.bus.states.items() if area != name]
    assert all(state.buses and state.quality != GOOD and state.split == system.split for state in others)
    system.bus.start(name)
    assert_over(system, scans=2)


@pytest.mark.parametrize("name", [AREAS[-1], *further(HUB)])
def test_an_area_that_is_cut_off_at_the_moment_of_going_over_follows_when_it_is_heard_again(name: str):
    system = at_rest("other cuts", *AREAS)
    system.scan()
    cut_off(system, name, True)
    system.scan(6)
    assert all(state.quality != GOOD for state in system.bus.states.values())
    cut_off(system, name, False)
    assert_over(system, scans=4)


def test_an_area_cut_off_before_all_hold_their_files_keeps_all_on_the_old_split():
    system = at_rest("other cuts", *OTHERS)
    cut_off(system, HUB, True)
    system.bus.offer(HUB, system.file(HUB))
    system.scan(6)
    assert {state.split for state in system.bus.states.values()} == {system.old[0].identity}
    cut_off(system, HUB, False)
    assert_over(system, scans=6)


def cut_off(system: GoingOver, name: str, is_cut: bool) -> None:
    """From all other areas, by either split."""
    for other in {*AREAS} - {name}:
        (system.bus.cut if is_cut else system.bus.heal)(name, other)


def test_of_two_next_splits_neither_is_taken_and_both_are_named():
    system = at_rest("other cuts", *OTHERS)
    third = files_of(NEXT["other network"], 60.0)
    system.bus.offer(HUB, next(content for content in third if content.area.name == HUB))
    assert_stays(system, note=f"the file of the next {third[0].identity} lies ready in 1 of {len(AREAS)} areas")
    assert_stays(system, note=f"the file of the next {system.split} lies ready in {len(OTHERS)} of {len(AREAS)} areas")
    system.bus.offer(HUB, system.file(HUB))
    assert_over(system, scans=2)


def test_an_edited_next_file_is_none_and_is_named_in_its_area():
    system = at_rest("other cuts", *OTHERS)
    edited = replace(system.file(HUB), tolerance=1e-7)
    system.bus.offer(HUB, edited)
    assert_stays(system, note=f"the file of the next {system.split} lies ready in {len(OTHERS)} of {len(AREAS)} areas")
    assert any(f"{edited.identity} cannot be used" in note for note in system.bus.states[HUB].notes)
    system.bus.offer(HUB, system.file(HUB))
    assert_over(system, scans=2)


def test_an_area_without_verdicts_names_the_next_file_that_lies_ready_and_one_that_was_edited():
    old, new = (
        files_of(replace(scenario, strategy="angle-offset"), later_s)
        for scenario, later_s in ((OLD, -60.0), (NEXT["other cuts"], 0.0))
    )
    bus = SimulatedBus(old, make_telemetry(OLD).by_area)
    bus.run(LONGEST_GAP_S)
    following = next(content for content in new if content.area.name == HUB)
    bus.offer(HUB, following)
    bus.run(LONGEST_GAP_S)
    remark = f"the file of the next {following.identity} lies ready: the area takes it once a neighbour works on"
    assert [name for name, state in bus.states.items() if any(remark in note for note in state.notes)] == [HUB]
    edited = replace(following, tolerance=1e-7)
    bus.offer(HUB, edited)
    bus.run(LONGEST_GAP_S)
    assert any(f"{edited.identity} cannot be used" in note for note in bus.states[HUB].notes)


def test_a_next_file_that_is_taken_away_again_keeps_all_on_the_old_split():
    system = at_rest("other cuts", *OTHERS)
    system.scan()
    system.bus.offer(OTHERS[0], None)
    system.bus.offer(HUB, system.file(HUB))
    assert_stays(system)


def test_an_area_that_comes_late_with_only_the_old_file_is_waited_for():
    system = at_rest("other cuts", *OTHERS)
    system.kill(HUB)
    system.scan(4)
    assert {s.split for s in system.bus.states.values()} == {system.old[0].identity}
    system.bus.start(HUB)
    assert_stays(system, scans=3)
    system.bus.offer(HUB, system.file(HUB))
    assert_over(system, scans=2)


def test_an_area_that_comes_late_with_only_the_new_file_takes_those_along_that_hold_theirs():
    system = at_rest("other cuts", *OTHERS)
    system.kill(HUB)
    system.scan(4)
    system.bus.files[HUB] = system.file(HUB)
    system.bus.start(HUB)
    assert_over(system, scans=2)


def test_an_area_that_has_lost_its_next_file_is_named_until_it_has_it_again():
    system = at_rest("other cuts", *AREAS)
    system.scan()
    system.kill(HUB)
    system.bus.next_files.pop(HUB)
    system.bus.start(HUB)
    system.scan(3)
    for name, state in system.bus.states.items():
        whose = "this area" if name == HUB else HUB
        assert state.quality != GOOD
        assert name not in (HUB, OTHERS[0]) or any(f"the file of {whose} is older" in note for note in state.notes)
    system.bus.offer(HUB, system.file(HUB))
    assert_over(system, scans=3)


def test_a_new_area_that_waits_with_its_file_is_joined():
    system = at_rest("another area", *AREAS)
    (name,) = {content.area.name for content in system.next} - {*AREAS}
    system.bus.files[name] = system.file(name)
    system.bus.start(name)
    system.scan()
    assert_over(system, scans=2)


def test_an_area_that_the_next_split_leaves_out_is_waited_for_until_it_is_stopped():
    system = GoingOver("one area less")
    system.scan()
    kept = [content.area.name for content in system.next]
    for name in kept:
        system.bus.offer(name, system.file(name))
    (name,) = {*AREAS} - {*kept}
    assert_stays(system, note=f"the file of the next {system.split} lies ready in {len(kept)} of {len(AREAS)} areas")
    system.kill(name)
    assert_over(system, scans=6)


@pytest.mark.random_cases(few=1, long=3, many=400)
def test_after_any_history_of_faults_all_areas_are_good_on_the_next_split_and_none_was_good_wrongly(random_seed: int):
    """Areas die, are cut off and come back, files come and go, links lose messages; then all is as it should be."""
    rng = np.random.default_rng(random_seed)
    system = GoingOver(WHAT[random_seed % 2], loss=float(rng.choice([0.0, 0.1, 0.3])), seed=random_seed)
    system.bus.run(float(rng.uniform(0.0, 1.0)))
    dead: set[str] = set()
    for _ in range(int(rng.integers(6, 16))):
        name = str(rng.choice(AREAS))
        match rng.choice(["offer", "offer", "offer", "take away", "kill", "start", "cut", "heal"]):
            case "offer":
                system.bus.offer(name, system.file(name) if system.bus.files[name].identity != system.split else None)
            case "take away":
                system.bus.offer(name, None)
            case "kill":
                system.kill(name)
                dead.add(name)
            case "start" if name in dead:
                dead.discard(name)
                system.bus.start(name)
            case "cut":
                cut_off(system, name, True)
            case "heal":
                cut_off(system, name, False)
        if rng.random() < 0.5:
            system.bus.next_scan(system.telemetry)
        system.bus.run(float(rng.exponential(0.2)))
    for name in AREAS:
        cut_off(system, name, False)
        if name in dead:
            system.bus.start(name)
        if system.bus.files[name].identity != system.split:
            system.bus.offer(name, system.file(name))
    for _ in range(12):
        system.scan()
        if system.is_over():
            break
    assert_over(system, scans=2)
