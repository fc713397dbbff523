"""A CSV file that grows: whole lines only, other files in its place, and nothing lost by a wrong line."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import pytest

from coordinator.field.gateway.sources.csv_file import CsvSettings, CsvSource, HeaderError

HEADER = "time,address,value,valid,unit\n"


def make_source(path: Path, **options: object) -> CsvSource:
    settings = CsvSettings.model_validate({"path": str(path), "poll_s": 0.01, **options})
    return CsvSource(settings, ["U1"])


def test_a_line_counts_when_it_is_whole(tmp_path: Path, recorder, reading, run) -> None:
    path = tmp_path / "r.csv"
    path.write_text(HEADER + "1800000000,U1,12.6,,\n")

    async def test() -> None:
        async with reading(make_source(path), recorder):
            await recorder.wait_until(lambda: len(recorder.readings) == 1)
            with path.open("a") as file:
                file.write("2027-01-15T08:00:01Z,U1,12.")
                file.flush()
                await asyncio.sleep(0.1)
                file.write("7,false,kV\n")
            await recorder.wait_until(lambda: len(recorder.readings) == 2)

    run(test())
    assert recorder.readings == [("U1", 12.6, 1.8e9, True, None), ("U1", 12.7, 1.8e9 + 1, False, "kV")]


def test_a_wrong_line_is_rejected_and_the_others_are_read(tmp_path: Path, recorder, reading, run) -> None:
    path = tmp_path / "r.csv"
    lines = [
        "1800000000,U1",
        '1800000000,U1,"12',
        "1800000000,U1,abc,,",
        "noon,U1,nan,,",
        "\xff,,,,",
        "1800000001,U1,12,,",
    ]
    path.write_text(HEADER + "\n".join(lines) + "\n" + "x" * 2_000_000 + "\n1800000002,U1,13,,\n", encoding="latin-1")

    async def test() -> None:
        async with reading(make_source(path), recorder):
            await recorder.wait_until(lambda: 13.0 in recorder.values_of("U1"))

    run(test())
    assert [reason for reason, _ in recorder.rejected] == ["malformed", "malformed", "no value", "malformed"]
    assert recorder.values_of("U1")[0] == "abc"
    assert recorder.values_of("U1")[2:] == [12.0, 13.0]


@pytest.mark.parametrize("header", [HEADER, "time,U1,U2,U3,U4\n"])
def test_no_line_without_a_reading_is_passed_over(tmp_path: Path, recorder, reading, run, header: str) -> None:
    path = tmp_path / "r.csv"
    path.write_text(header + ",,,,\n\n1800000000,,,,\n1800000001,U1,13,,\n")

    async def test() -> None:
        async with reading(make_source(path), recorder):
            await recorder.wait_until(lambda: len(recorder.readings) > 0)

    run(test())
    there = "there is nothing where a value belongs"
    assert recorder.rejected == [
        ("no value", f"line ',,,,': {there}"),
        ("no value", f"line '1800000000,,,,': {there}"),
    ]


def test_a_file_in_its_place_is_read_from_its_beginning(tmp_path: Path, recorder, reading, run) -> None:
    path, new = tmp_path / "r.csv", tmp_path / "new.csv"
    path.write_text(HEADER + "1800000000,U1,1,,\n")

    async def test() -> None:
        async with reading(make_source(path), recorder):
            await recorder.wait_until(lambda: recorder.values_of("U1") == [1.0])
            new.write_text("time;U1;U2\n1800000000;2;\n".replace(";", ","))
            new.replace(path)
            await recorder.wait_until(lambda: recorder.values_of("U1") == [1.0, 2.0])
            path.write_text("time,U1\n")
            await recorder.wait_until(lambda: path.stat().st_size == 8)
            await asyncio.sleep(0.1)
            with path.open("a") as file:
                file.write("1800000001,3\n")
            await recorder.wait_until(lambda: recorder.values_of("U1") == [1.0, 2.0, 3.0])

    run(test())
    assert recorder.rejected == []
    assert recorder.values_of("U2") == []


@pytest.mark.parametrize(
    ("header", "expected"),
    [("address,value\n", "no column 'time'"), ("time,U1,U1\n", "column 'U1' stands twice"), ("a;b\n", "'time'")],
)
def test_a_header_that_cannot_be_used_is_an_error(tmp_path: Path, recorder, run, header: str, expected: str) -> None:
    path = tmp_path / "r.csv"
    path.write_text(header)
    with pytest.raises(HeaderError, match=expected):
        run(make_source(path).read(recorder))


def test_a_file_that_is_not_there_is_an_error(tmp_path: Path, recorder, run) -> None:
    with pytest.raises(FileNotFoundError):
        run(make_source(tmp_path / "r.csv").read(recorder))


def test_a_pipe_is_refused_at_once(tmp_path: Path, recorder, run) -> None:
    os.mkfifo(tmp_path / "r.csv")
    with pytest.raises(OSError, match="is a pipe or a device"):
        run(make_source(tmp_path / "r.csv").read(recorder))
