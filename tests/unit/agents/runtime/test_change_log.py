"""An agent's log over months: each thing when it comes and when it goes, not what is so in every scan."""

from __future__ import annotations

import math
import random

import pytest

from agents.protocol.events import Conclude
from agents.runtime.log import FIRST_WAIT_S, LONGEST_WAIT_S, ChangeLog

ESTIMATES = ("estimates", "")


def end(scan: int, *gone: str) -> Conclude:
    text = "; ".join(["estimates", *(f"{area} is gone" for area in gone)])
    return Conclude(scan, text, frozenset([ESTIMATES, *(("is gone", area) for area in gone)]))


@pytest.fixture
def changes(caplog: pytest.LogCaptureFixture) -> ChangeLog:
    caplog.set_level("INFO")
    return ChangeLog()


def test_what_is_so_in_every_scan_is_logged_once_and_what_changes_at_once(
    changes: ChangeLog, caplog: pytest.LogCaptureFixture
):
    for scan in range(1000):
        changes.take(end(scan), float(scan))
    assert caplog.messages == ["scan 0: estimates"]
    for scan in range(1000, 1030):
        changes.take(end(scan, "area2"), float(scan))
    changes.take(end(1030, "area2", "area3"), 1030.0)
    for scan in range(1031, 1060):
        changes.take(end(scan), float(scan))
    assert caplog.messages[1:] == [
        "scan 1000: estimates; area2 is gone",
        "scan 1030: estimates; area2 is gone; area3 is gone",
        "scan 1031: estimates",
    ]


def test_figures_that_change_from_scan_to_scan_are_no_change(changes: ChangeLog, caplog: pytest.LogCaptureFixture):
    findings = frozenset([ESTIMATES, ("clock ahead of", "area2")])
    for scan in range(1000):
        changes.take(Conclude(scan, f"estimates; the clock of area2 is {scan / 1000} s ahead", findings), float(scan))
    assert len(caplog.messages) == 1


def test_what_comes_and_goes_all_the_time_is_logged_ever_more_rarely(
    changes: ChangeLog, caplog: pytest.LogCaptureFixture
):
    meters, scans, draw = 40, 20_000, random.Random(1)
    for scan in range(scans):
        silent = [f"vm@{k}" for k in range(meters) if draw.random() < 0.05]
        changes.take(end(scan, *silent), float(scan))
    most_of_each = 2 + math.log2(scans / FIRST_WAIT_S)
    assert 2 < len(caplog.messages) < most_of_each * (meters + 1) < scans / 20


def test_what_was_quiet_for_a_day_is_logged_at_once(changes: ChangeLog, caplog: pytest.LogCaptureFixture):
    for scan in range(2000):
        changes.take(end(scan, *["area2"] * (scan % 2)), float(scan))
    before = len(caplog.messages)
    changes.take(end(2000), 2000.0)
    findings = len(caplog.messages)
    assert findings - before <= 1
    at = 2000 + round(LONGEST_WAIT_S)
    changes.take(end(at, "area2"), float(at))
    assert caplog.messages[findings:] == [f"scan {at}: estimates; area2 is gone"]


def test_what_holds_at_last_is_logged_however_often_it_has_changed(
    changes: ChangeLog, caplog: pytest.LogCaptureFixture
):
    for scan in range(1000):
        changes.take(end(scan, *["area2"] * (scan % 2)), float(scan))
    for scan in range(1000, 5000):
        changes.take(end(scan, "area2"), float(scan))
    assert caplog.messages[-1].endswith("estimates; area2 is gone")


def test_neighbours_may_name_what_they_like_without_making_the_process_grow(changes: ChangeLog):
    for scan in range(110):
        changes.take(end(scan, *(f"{scan}-{k}" for k in range(200))), float(scan))
    assert len(changes._facts) <= 20_200
