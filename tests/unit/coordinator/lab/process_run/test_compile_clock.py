"""Compiling is said once, and no time limit runs meanwhile."""

from __future__ import annotations

import pytest

from coordinator.lab.process_run import compile_clock
from coordinator.lab.process_run.compile_clock import CompileClock


class Time:
    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    time = Time()
    monkeypatch.setattr(compile_clock, "time", time)
    return time


def test_the_clock_starts_when_all_is_compiled_here_and_in_the_parent(time: Time):
    clock = CompileClock()
    assert clock.find_start(90.0) == 90.0
    clock.take(True, None)
    clock.take(True, None)
    time.now = 120.0
    clock.take(False, None)
    time.now = 125.0
    assert clock.find_start(90.0) == 125.0  # one still compiles
    clock.take(False, None)
    time.now = 140.0
    assert clock.find_start(90.0) == 125.0
    assert clock.find_start(130.0) == 130.0


def test_the_user_is_reported_once_whether_it_will_happen_again():
    notes: list[str] = []
    clock = CompileClock()
    clock.notify = notes.append
    for begins in (True, False, True, False):
        clock.take(begins, "/cache")
    assert len(notes) == 1
    assert "happens once: the code is kept in /cache" in notes[0]
    clock.notify = notes.append
    clock.take(True, None)
    assert "no safe folder" in notes[1]
