"""JSON lines on standard input, in a pipe: bad ones are counted, and others can work while many come."""

from __future__ import annotations

import asyncio
import os
import threading

import pytest

from coordinator.field.gateway.sources import json_lines
from coordinator.field.gateway.sources.json_lines import JsonLinesSettings, JsonLinesSource
from coordinator.field.gateway.sources.lines import LineCutter


@pytest.fixture
def stdin(monkeypatch: pytest.MonkeyPatch):
    """The end to write to of a pipe that stands for standard input."""
    reading_end, writing_end = os.pipe()
    monkeypatch.setattr(json_lines, "STDIN", reading_end)
    file = os.fdopen(writing_end, "wb", buffering=0)
    yield file
    file.close()
    os.close(reading_end)


def make_source() -> JsonLinesSource:
    return JsonLinesSource(JsonLinesSettings(), ["U1"])


def test_it_reads_both_forms_and_rejects_what_is_none(stdin, recorder, run) -> None:
    stdin.write(
        b'{"address": "U1", "value": 12.6, "time": "2027-01-15T08:00:00Z", "valid": false, "unit": "kV"}\n'
        b'{"time": 1800000000, "values": {"U1": 1, "U2": null}}\n'
        b"[1, 2]\n"
        b'{"time": 1800000000, "values": {}}\n'
        b'{"address": "U1"}\n'
        b'{"address": "U1", "address": "U2", "value": 1}\n'
        b"not json\n"
        b'{"address": 7, "value": 1}\n' + b"[" * 20_000 + b"\n"
        b"\n"
        b'{"address": "U1", "value": NaN}\n'
        b'{"address": "U1", "value": 13}'
    )
    stdin.close()
    run(make_source().read(recorder))
    assert recorder.readings[:3] == [
        ("U1", 12.6, 1.8e9, False, "kV"),
        ("U1", 1, 1800000000, True, None),
        ("U2", None, 1800000000, True, None),
    ]
    assert recorder.readings[3][1] != recorder.readings[3][1]
    assert recorder.readings[4] == ("U1", 13, None, True, None)
    assert [reason for reason, _ in recorder.rejected] == ["malformed"] * 7
    assert "'address' is given twice" in recorder.rejected[3][1]


def test_a_line_of_a_mebibyte_that_repeats_one_key_is_one_malformed_line(recorder) -> None:
    line = b'{"values": {' + b'"U1":1,' * 149_700 + b'"U1":1}}\n'
    assert 2**20 - 1000 < len(line) < 2**20
    for text in LineCutter().cut(line):
        json_lines._take(text, recorder)
    assert recorder.readings == []
    assert [reason for reason, _ in recorder.rejected] == ["malformed"]
    assert "key 'U1' is given twice" in recorder.rejected[0][1]


def test_a_unit_stated_for_many_values_is_that_of_each(stdin, recorder, run) -> None:
    stdin.write(b'{"unit": "MW", "values": {"U1": 1, "U2": 2}}\n')
    stdin.close()
    run(make_source().read(recorder))
    assert [(address, unit) for address, *_, unit in recorder.readings] == [("U1", "MW"), ("U2", "MW")]


def test_while_a_flood_comes_in_others_can_work_and_nothing_is_lost(stdin, recorder, run) -> None:
    count, turns = 50_000, 0

    def write() -> None:
        for k in range(count):
            stdin.write(b'{"address": "U1", "value": %d}\n' % k)
        stdin.close()

    async def test() -> None:
        nonlocal turns
        threading.Thread(target=write).start()
        task = asyncio.create_task(make_source().read(recorder))
        while not task.done():
            await asyncio.sleep(0)
            turns += 1
        await task

    run(test())
    assert recorder.values_of("U1") == list(range(count))
    assert turns > 10


def test_it_ends_while_standard_input_is_silent(stdin, recorder, reading, run) -> None:
    async def test() -> None:
        async with reading(make_source(), recorder):
            stdin.write(b'{"address": "U1", "value": 1}\n')
            await recorder.wait_until(lambda: bool(recorder.readings))

    run(test())
    assert recorder.values_of("U1") == [1]
