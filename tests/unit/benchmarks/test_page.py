"""The benchmark of the page finds the longest task by its processor time, and its areas say something new each time."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest

from benchmarks.page.command import list_tasks
from benchmarks.page.feed import Feed
from benchmarks.page.tasks import MAIN_THREAD, find_tasks
from coordinator.lab.evaluation.evaluation import choose_scenario
from coordinator.show.web.moment import Moments
from coordinator.watch.observe.grid_tables import GridTables

pytestmark = pytest.mark.slow


def event(name: str, pid: int, ts: float, dur: float, tdur: float, **args: Any) -> dict[str, Any]:
    return {"name": name, "ph": "X", "pid": pid, "tid": 1, "ts": ts, "dur": dur, "tdur": tdur, "args": args}


def thread(pid: int, name: str) -> dict[str, Any]:
    return {"name": "thread_name", "ph": "M", "pid": pid, "tid": 1, "ts": 0, "args": {"name": name}}


def test_a_task_that_waited_for_a_processor_is_not_the_longest():
    call = {"functionName": "draw", "url": "http://127.0.0.1/static/feeder.js", "lineNumber": 81}
    events = [
        thread(1, MAIN_THREAD),
        thread(2, MAIN_THREAD),
        thread(3, "CrGpuMain"),
        event("RunTask", 1, 1_000, 900_000, 4_000),
        event("RunTask", 1, 1_001_000, 60_000, 30_000),
        event("FunctionCall", 1, 1_002_000, 50_000, 25_000, data=call),
        event("RunTask", 2, 1_000, 500, 500),
        event("RunTask", 3, 1_000, 99_000, 99_000),
    ]
    found = find_tasks(json.dumps({"traceEvents": events}).encode())
    assert [(task.cpu_ms, task.wall_ms) for task in found] == [(30.0, 60.0), (4.0, 900.0)]
    assert found[0].inside == (("FunctionCall draw feeder.js:81", 25.0),)
    assert list_tasks(found, 1).splitlines()[-1] == "| 1.0 | 30.0 | 60 | FunctionCall draw feeder.js:81 25.0 |"


def test_every_look_at_the_made_up_areas_is_a_new_scan_of_all_buses_and_meters():
    scenario = choose_scenario("ieee33")
    feed, moments = Feed(scenario), Moments(GridTables(scenario))
    first, second = (moments.make(feed(0.0), time.monotonic(), at) for at in (1.0, 2.0))
    for moment, scan in ((first, 1), (second, 2)):
        assert {area["scan"] for area in moment["view"]["areas"].values()} == {scan}
        assert {area["state"] for area in moment["view"]["areas"].values()} == {"estimates"}
        assert None not in moment["buses"]["vm_pu"]
        assert "silent" not in moment["meters"]["status"]
    assert first["buses"]["vm_pu"] != second["buses"]["vm_pu"]
