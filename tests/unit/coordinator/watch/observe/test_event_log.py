"""The log of a long run: parts of a limited size, of which the first and the newest stay."""

from __future__ import annotations

import json
from pathlib import Path

from coordinator.watch.observe.event_log import EventLog


def events_in(path: Path) -> list[int]:
    return [json.loads(line)["number"] for line in path.read_text().splitlines()]


def test_a_log_of_months_does_not_fill_the_disk_and_keeps_its_beginning_and_its_end(tmp_path: Path):
    with EventLog(tmp_path / "events.jsonl", 0.0, part_bytes=1000, most_parts=3) as log:
        for number in range(1000):
            log.write("tick", 0.0, number=number)
    assert log.failure is None
    parts = sorted(tmp_path.iterdir(), key=lambda path: int(path.stem.partition("-")[2] or 0))
    assert len(parts) == 4
    assert sum(path.stat().st_size for path in parts) < 4 * 1100
    first, *newest = map(events_in, parts)
    assert first == list(range(len(first)))
    kept = [number for part in newest for number in part]
    assert kept == list(range(kept[0], 1000))


def test_a_log_that_is_small_is_one_file(tmp_path: Path):
    with EventLog(tmp_path / "events.jsonl", 0.0) as log:
        for number in range(100):
            log.write("tick", 0.0, number=number)
    assert [path.name for path in tmp_path.iterdir()] == ["events.jsonl"]
    assert events_in(tmp_path / "events.jsonl") == list(range(100))
