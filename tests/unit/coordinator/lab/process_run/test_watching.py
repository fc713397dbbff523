"""Looking at all areas takes little of the time of watching, however many they are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from coordinator.lab.process_run import run_scenario
from coordinator.watch.observe.observer import Standing

LOOK_S = 2.0  # that one look takes
LIMIT_S = 1000.0


class Clock:
    now = 0.0

    def monotonic(self) -> float:
        return self.now

    def pass_time(self, seconds: float) -> None:
        self.now += seconds


def test_looks_that_take_long_do_not_follow_each_other_at_once(monkeypatch: pytest.MonkeyPatch):
    clock, looks = Clock(), []

    def look(_: float) -> Standing:
        looks.append(clock.now)
        clock.pass_time(LOOK_S)
        return Standing(("something is missing",))

    def take(wait_s: float) -> list[Any]:
        clock.pass_time(wait_s)
        return []

    monkeypatch.setattr(run_scenario, "time", clock)
    monkeypatch.setattr(run_scenario, "clock", SimpleNamespace(find_start=lambda started: started))
    run: Any = SimpleNamespace(
        scenario=SimpleNamespace(run=SimpleNamespace(beat_s=1.0, timeout_s=LIMIT_S), time_limit_s=LIMIT_S),
        updates=SimpleNamespace(take=take),
        duplicates=SimpleNamespace(find_lasting=lambda _: []),
        schedule=SimpleNamespace(describe_obstacles=lambda: (), steps=()),
        joined=None,
        started=0.0,
    )
    observer: Any = SimpleNamespace(standing=look)
    assert run_scenario._watch(run, observer, None)
    assert len(looks) * LOOK_S <= 2 * run_scenario.LOOK_SHARE * LIMIT_S
