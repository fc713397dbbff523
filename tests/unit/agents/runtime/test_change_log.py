"""An agent's log over months: what changes, not what is so in every scan."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest
from shown_states import a_state

from agents.runtime.loop import SAID_LATELY_S, _ChangeLog


def in_scan(scan: int, *notes: str):
    state = a_state(notes=notes)
    return replace(state, header=replace(state.header, scan=scan))


def test_a_day_of_equal_scans_is_a_few_lines_and_what_is_new_is_logged_at_once(caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO)
    changes = _ChangeLog()
    for scan in range(1000):  # one a second, each with a moment of work
        changes.take(in_scan(scan, "area2 has not come to the end of this term"), scan + 0.0)
        changes.take(in_scan(scan), scan + 0.5)
    assert len(caplog.messages) == 2
    changes.take(in_scan(1000, "neighbour area2 is gone"), 1000.0)
    assert caplog.messages[2:] == ["scan 1000: estimates; neighbour area2 is gone"]
    for scan in range(1000, 1000 + 2 * round(SAID_LATELY_S)):
        changes.take(in_scan(scan, "neighbour area2 is gone"), float(scan))
    changes.take(in_scan(1030), 1030.0)
    assert caplog.messages[3:] == ["scan 1030: estimates"]
