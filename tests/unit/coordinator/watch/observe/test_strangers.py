"""Who is no part of the scenario finds no place in the memory of those who watch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import pytest
import zenoh

from agents.messages.checks import LONGEST_NAME
from agents.messages.keys import live_key
from agents.messages.packing import Header, Incarnation
from agents.runtime import presence
from agents.runtime.link_faults import LOST
from agents.runtime.presence import MAX_INCARNATIONS, Presence
from coordinator.lab.process_run.run_status import listen
from coordinator.watch.observe import watcher as watch
from coordinator.watch.observe.state_log import StateLog
from coordinator.watch.observe.updates import Updates
from coordinator.watch.observe.watcher import Watcher
from scenarios.scenario import load_scenario
from tests.support.shown_states import a_state, published_by

INCARNATION = Incarnation(1, 1)


class Bus:
    """Passes on what a listener asks of its session."""

    def __init__(self) -> None:
        self._leaves: list[tuple[zenoh.KeyExpr, Callable[[str, bytes], None]]] = []
        self._tokens: list[tuple[zenoh.KeyExpr, Callable[[str, bool], None]]] = []

    def subscribe(self, keys: str, callback: Callable[[str, bytes], None]) -> None:
        self._leaves.append((zenoh.KeyExpr(keys), callback))

    def watch_presence(self, keys: str, callback: Callable[[str, bool], None]) -> None:
        self._tokens.append((zenoh.KeyExpr(keys), callback))

    def declare_presence(self, key: str) -> None:
        pass

    def show(self, key: str) -> None:
        for asked, callback in self._tokens:
            if asked.includes(zenoh.KeyExpr(key)):
                callback(key, True)

    def leave(self, key: str) -> None:
        for asked, callback in self._leaves:
            if asked.includes(zenoh.KeyExpr(key)):
                callback(key, b"SIGTERM")


def test_a_run_takes_in_the_tokens_of_its_own_processes_only():
    bus, clock = Bus(), SimpleNamespace(incarnation=INCARNATION)
    run = SimpleNamespace(id="run", updates=Updates(), scenario=load_scenario("ieee33"), clock=clock)
    listen(run, bus)  # type: ignore[arg-type]
    for role, name in (("area", "area99"), ("plant", "other"), ("stranger", "area1"), ("gateway", "north")):
        bus.show(live_key("run", role, name, INCARNATION))
        bus.leave(live_key("run", role, name, INCARNATION))
    assert run.updates.take(0.0) == []
    for role, name in (("area", "area1"), ("plant", "plant"), ("coordinator", "coordinator")):
        bus.show(live_key("run", role, name, INCARNATION))
    assert len(run.updates.take(0.0)) == 3
    bus.leave(live_key("run", "area", "area1", INCARNATION))
    assert len(run.updates.take(0.0)) == 1


def test_states_and_tokens_that_nobody_takes_in_do_not_pile_up():
    updates = Updates(most=10)
    for k in range(100):
        updates.offer(k)
    for k in range(100):
        updates.offer(-k, sent_once=True)
    updates.put("the end of a process")
    assert updates.take(0.0) == [*range(10), *range(0, -10, -1), "the end of a process"]
    assert (updates.take_dropped(), updates.take_dropped()) == (180, 0)


def test_of_one_name_no_more_incarnations_are_kept_than_anybody_needs_and_no_more_names(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(presence, "MAX_NAMES", 3)
    kept = Presence()
    for start in range(2 * MAX_INCARNATIONS):
        kept.take(live_key("run", "area", "area1", Incarnation(start, 1)), True)
    assert len(kept.incarnations_of("area", "area1")) == MAX_INCARNATIONS
    for k in range(10):
        kept.take(live_key("run", "area", f"stranger{k}", INCARNATION), True)
    assert len(kept.names) == 3
    kept.take(live_key("run", "area", "stranger0", INCARNATION), False)
    assert kept.take(live_key("run", "area", "area2", INCARNATION), True), "there is room again"
    assert not kept.take(live_key("run", "area", "x" * (LONGEST_NAME + 1), INCARNATION), True)


def test_a_watcher_keeps_so_many_areas_and_no_more(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(watch, "MAX_NAMES", 5)
    monkeypatch.setattr(watch, "MOST_AREAS", 5)
    watcher = Watcher("run")
    for k in range(20):
        watcher.take_state(published_by(f"area{k}", INCARNATION, sent={f"made-up{j}": (1, 1) for j in range(20)}), 0.0)
        watcher.take_leave(live_key("run", "area", f"area{k}", INCARNATION), "SIGTERM")
    assert len(watcher.look(0.0).areas) == 5
    assert len(watcher._received) == len(watcher._leave_reasons) == 5


def test_faults_that_no_link_has_and_ever_new_incarnations_leave_no_trace_in_a_runs_sums():
    log = StateLog(None)
    for start in range(50):
        state = a_state(faults={LOST: 2, f"made up {start}": 5})
        log.take(replace(state, header=Header("run", "area1", Incarnation(start, 1), 1, 1, 0.0)), 0.0, True)
    assert log.faults == Counter({LOST: 100})
    assert len(log._counted) == 1
