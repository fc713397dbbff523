"""What the operator's commands leave in ``events.jsonl`` of a run."""

from __future__ import annotations

import json
from pathlib import Path

from coordinator.watch.observe.event_log import EventLog
from coordinator.watch.observe.state_log import StateLog
from tests.support.shown_states import a_state


def test_each_command_that_an_area_has_followed_is_one_event(tmp_path: Path):
    with EventLog(tmp_path / "events.jsonl", started=0.0) as events:
        log = StateLog(events)
        first = a_state(command=(5, 6, 1), meters_off=("vm@1",))
        for at, state in enumerate((a_state(), first, first, a_state(command=(5, 6, 2)))):
            log.take(state, float(at), is_new=False)
    lines = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    followed = [line for line in lines if line["event"] == "command followed"]
    assert followed == [
        {"time": 1.0, "event": "command followed", "area": "area1", "command": [5, 6, 1], "meters_off": ["vm@1"]},
        {"time": 3.0, "event": "command followed", "area": "area1", "command": [5, 6, 2], "meters_off": []},
    ]
