"""The clock of the host, followed when it is set."""

from __future__ import annotations

import time

import pytest

from agents.runtime.loop import LEAST_STEP_S, HostClock


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Both clocks of the host, which stand still; each reading of the monotonic one takes ``step``."""
    now = {"wall": 1.7e9, "monotonic": 100.0, "step": 0.0}

    def read_monotonic() -> float:
        now["monotonic"] += now["step"]
        return now["monotonic"]

    monkeypatch.setattr(time, "time", lambda: now["wall"])
    monkeypatch.setattr(time, "monotonic", read_monotonic)
    return now


def test_a_clock_that_is_set_is_reported_once(clocks):
    clock = HostClock(error_s=3.0)
    assert clock.offset == pytest.approx(1.7e9 - 100.0 + 3.0)
    assert not clock.has_been_set()
    clocks["wall"] -= 3600.0
    assert clock.has_been_set()
    assert clock.offset == pytest.approx(1.7e9 - 3600.0 - 97.0)
    assert not clock.has_been_set()


def test_neither_a_hair_nor_an_interruption_is_a_step(clocks):
    clock = HostClock()
    clocks["wall"] += LEAST_STEP_S / 2
    assert not clock.has_been_set()
    clocks["step"], clocks["wall"] = 0.05, clocks["wall"] + 0.05  # between the two readings the process slept
    assert not clock.has_been_set()
