"""Clocks that are wrong, or are set while areas run: both sides of a boundary name them, and nobody is good."""

from __future__ import annotations

import pytest

from agents.messages.packing import DownMessage, HeartbeatMessage, UpMessage
from coordinator.lab.simulator.simulator import STARTED_AT
from tests.support.levels import further
from tests.support.ticking import SCAN_S, Ticking, by_clock

AREAS = ("area1", "area2", "area3")
SHARP = 1e-9  # p.u. and rad


@pytest.mark.parametrize(
    "error_s", [3.0, -100.0, *(pytest.param(s, marks=pytest.mark.long) for s in (-3.0, 100.0, 3600.0, -3600.0))]
)
def test_a_clock_that_is_off_is_named_by_both_sides_and_nobody_is_good(error_s):
    run = Ticking(by_clock(faults__clock_error_s={"area2": error_s}))
    run.run(6.5)
    assert "good" not in run.qualities().values()
    there, back = ("ahead of", "behind") if error_s > 0 else ("behind", "ahead of")
    assert f"the clock of area2 is {abs(error_s):.2g} s {there} that of this area" in run.notes_of("area1")
    assert f"the clock of area1 is {abs(error_s):.2g} s {back} that of this area" in run.notes_of("area2")
    assert run.bus.states["area1"].clock_skews["area2"] == pytest.approx(error_s, abs=0.01)
    assert run.bus.states["area2"].clock_skews["area1"] == pytest.approx(-error_s, abs=0.01)
    assert run.bus.states["area1"].clock_skews["area3"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("error_s", [0.1, -0.1])
def test_a_clock_that_is_off_by_less_than_a_quarter_of_a_scan_is_not_worth_a_word(error_s):
    run = Ticking(by_clock(faults__clock_error_s={"area2": error_s}))
    run.run(0.5)
    for _ in range(5):
        run.run(SCAN_S)
        assert set(run.qualities().values()) == {"good"}
        assert run.find_gap() < SHARP
    assert all("clock" not in run.notes_of(name) for name in AREAS)
    assert run.bus.states["area1"].clock_skews["area2"] == pytest.approx(error_s, abs=0.01)


@pytest.mark.parametrize("error_s", [2.0, *further(-50.0, -2.0, 50.0)])
def test_a_clock_that_is_set_wrong_and_right_again_does_no_lasting_harm(error_s):
    run = Ticking(by_clock())
    run.run(3.5)
    run.bus.set_clock("area2", error_s)
    run.run(4.0)
    assert "good" not in run.qualities().values()
    run.bus.set_clock("area2", 0.0)
    run.run(max(10.0, error_s) + 5.0)  # terms never go back: until clocks have come to the last one, and some
    assert set(run.qualities().values()) == {"good"}
    assert run.find_gap() < SHARP
    assert {state.header.scan for state in run.bus.states.values()} == {int(STARTED_AT + run.bus.now)}


def test_clocks_that_are_all_set_forward_together_are_followed():
    run = Ticking(by_clock(measurements__injection__oldest_s=86400.0))
    run.run(2.5)
    for name in AREAS:
        run.bus.set_clock(name, 5.0)
    run.run(3.0)
    assert {state.header.scan for state in run.bus.states.values()} == {int(STARTED_AT) + 10}


def test_send_times_never_go_back():
    run = Ticking(by_clock())
    run.run(2.5)
    run.bus.set_clock("area2", -3600.0)
    run.run(3.0)
    times: dict[tuple[str, str], float] = {}
    for _, sender, receiver, message in run.bus.delivered:
        if isinstance(message, HeartbeatMessage | UpMessage | DownMessage):
            assert message.header.time > times.get((sender, receiver), 0.0)
            times[sender, receiver] = message.header.time
    assert len(times) == 4
