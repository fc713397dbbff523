"""Quality, notes, `degraded`, report, watcher and exit code never contradict each other, whatever is found."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from agents.messages.packing import Incarnation, StateMessage
from agents.protocol.quality import (
    DEGRADED,
    GOOD,
    NONE,
    QUALITIES,
    RELATIVE_ANGLE,
    STALE,
    UNOBSERVABLE,
    Finding,
    assess,
)
from coordinator.lab.evaluation.evaluation import Centralised, evaluate, make_observer
from coordinator.lab.evaluation.result import RunResult, as_json
from coordinator.show.report.text import format_verdict
from coordinator.watch.observe.watcher import Watcher
from scenarios.scenario import load_scenario
from scenarios.telemetry import make_telemetry
from tests.support.levels import further
from tests.support.shown_states import published_by

SCENARIO = load_scenario("industrial13")
TELEMETRY = make_telemetry(SCENARIO)
FINDINGS = [Finding(quality, f"it is {quality}") for quality in QUALITIES] + [Finding(DEGRADED, "a second reason")]
SETS = [found for n in range(len(FINDINGS) + 1) for found in itertools.combinations(FINDINGS, n)]
INCARNATION = Incarnation(1, 1)


def a_state_with(area, found: tuple[Finding, ...]) -> StateMessage:
    """As an area publishes it that has found this."""
    quality, notes = assess(found)
    qualities = {finding.quality for finding in found}
    numbers = {"buses": (), "vm": (), "va": (), "sigma_vm": (), "sigma_va": ()}
    if not qualities & {NONE, UNOBSERVABLE}:
        n = len(area.network.buses)
        numbers = {"buses": tuple(b.id for b in area.network.buses), "vm": (1.0,) * n, "va": (0.0,) * n}
        numbers |= {"sigma_vm": (0.001,) * n, "sigma_va": (0.001,) * n}
    numbered = {neighbour.area: (1, 1) for neighbour in area.neighbours}
    changes = {
        "quality": quality,
        "notes": notes,
        "referenced": RELATIVE_ANGLE not in qualities,
        "sent": numbered,
        "received": numbered,
    }
    return published_by(area.name, INCARNATION, **numbers, **changes, telemetry_age=0.0)


def results(found: tuple[Finding, ...], *, is_gone: bool) -> Iterator[tuple[RunResult, Watcher]]:
    """What a run and a watcher say, soon and long after the last change, with these findings in area1."""
    observer, watcher = make_observer(SCENARIO, "run"), Watcher("run")
    for area in SCENARIO.partition.areas:
        observer.take_presence(area.name, True, 0.0)
        watcher.take_presence(f"dsse/v3/run/live/area/{area.name}/{INCARNATION}", True)
    states = [a_state_with(area, found if area.name == "area1" else ()) for area in SCENARIO.partition.areas]
    for now in (1.0, 100.0):
        for state in states:
            observer.take_state(state, now)
            watcher.take_state(replace(state, header=replace(state.header, run="run")), now)
        if is_gone:
            observer.take_presence("area1", False, now)
            watcher.take_presence(f"dsse/v3/run/live/area/area1/{INCARNATION}", False)
        standing = observer.standing(now)
        reason = "; ".join(standing.obstacles) or standing.dead_end
        outcome = evaluate(
            SCENARIO,
            "run",
            observer,
            TELEMETRY,
            Centralised(None, "not asked for"),
            reason or None,
            started=0.0,
            wall_s=1.0,
            virtual_s=now,
            timing_s={},
            faults={},
        )
        yield outcome.in_folder(Path("nowhere")), watcher


def test_a_quality_has_its_reason_first_and_a_good_state_has_none():
    for found in SETS:
        quality, notes = assess(found)
        assert set(notes) == {finding.note for finding in found}
        reasons = [finding.note for finding in found if finding.quality == quality != GOOD]
        assert (quality == GOOD) == (not reasons)
        assert quality == GOOD or notes[0] in reasons


@pytest.mark.slow
@pytest.mark.parametrize("is_gone", [False, True], ids=["there", "gone"])
@pytest.mark.parametrize("most", [2, *further(len(FINDINGS))])
def test_run_report_and_watcher_say_the_same_of_every_combination_of_findings(is_gone: bool, most: int):
    for found in (found for found in SETS if len(found) <= most):
        for result, watcher in results(found, is_gone=is_gone):
            (area,) = [area for area in result.area_results if area.name == "area1"]
            (view,) = [view for view in watcher.look(1.0).areas if view.name == "area1"]
            reported = as_json(result)["areas"]["area1"]
            assert reported["degraded"] == (reported["quality"] != GOOD)
            assert area.quality == view.quality
            assert area.quality == GOOD or area.notes
            lines = format_verdict(result).splitlines()
            reported_of = [line for line in lines if ": area1: " in line]
            assert reported_of == [
                f"{area.quality if area.degraded else 'note'}: area1: {'; '.join(area.notes)}"
            ] * bool(area.notes)
            assert any(line.startswith("area1 ") and line.endswith(f" {area.quality}") for line in lines)
            if is_gone:
                assert area.quality in (STALE, NONE)
                assert "area1 is not on the bus" in area.notes[0]
            else:
                assert (area.quality, area.notes) == assess(found)
                assert view.notes == area.notes
            if result.verdict.consensus:  # exit code 0
                assert area.quality in (GOOD, DEGRADED)
                assert lines[0].startswith("consensus")
            else:
                assert result.verdict.reason


@pytest.mark.parametrize("found", [found for found in SETS if not {f.quality for f in found} & {NONE, UNOBSERVABLE}])
def test_an_area_whose_neighbour_publishes_another_voltage_is_not_good_even_if_it_says_so(found: tuple[Finding, ...]):
    observer = make_observer(SCENARIO, "run")
    for area in SCENARIO.partition.areas:
        observer.take_presence(area.name, True, 0.0)
        state = a_state_with(area, found)
        observer.take_state(replace(state, vm=tuple(vm + 0.01 * (area.name == "area2") for vm in state.vm)), 1.0)
    is_compared = RELATIVE_ANGLE not in {f.quality for f in found}
    for area in SCENARIO.partition.areas:
        quality, notes = observer.assess_area(area.name, 1.0)
        assert any("differ by 0.01 p.u. at bus 3" in note for note in notes) == is_compared
        own = assess(found).quality
        assert quality == (DEGRADED if own == GOOD else own)
    assert observer.standing(1.0).obstacles
