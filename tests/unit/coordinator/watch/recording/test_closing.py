"""Closing: what a log says stands in the tables, once, and a damaged log loses what is damaged and nothing else."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from coordinator.watch.recording import closing, parquet
from coordinator.watch.recording.closing import NO_PARQUET, close_ended, remove_oldest
from coordinator.watch.recording.entries import Entry, note
from coordinator.watch.recording.folder import LOGS, begin_writing, list_segments
from coordinator.watch.recording.frames import MARK
from dsse_core.errors import InvalidInputError
from tests.support.recordings import (
    AT,
    Record,
    appeared,
    entry_of,
    load_areas_of,
    make_readings,
    make_state,
    read_table,
)

HOUR = 3600.0
AREAS = load_areas_of()


def _scans(count: int, at: float = AT) -> list[Entry]:
    entries = []
    for scan in range(1, count + 1):
        for content in AREAS:
            when = at + scan
            entries.append(entry_of(make_readings(content, scan, scan, when), when))
            entries.append(entry_of(make_state(content, scan, scan, when), when))
    return entries


def test_every_scan_of_every_area_stands_in_the_tables(record: Record) -> None:
    folder = record([appeared("area1"), *_scans(5)])
    assert close_ended(folder) == []
    names, scans = {content.area.name for content in AREAS}, set(range(1, 6))
    everything = {(area, scan) for area in names for scan in scans}
    assert {(row["area"], row["scan"]) for row in read_table(folder, "states") if row["final"]} == everything
    readings = read_table(folder, "readings")
    assert len(readings) == 5 * sum(len(content.meters) for content in AREAS)
    first = AREAS[0].meters[1].id
    row = next(row for row in readings if row["meter"] == first and row["scan"] == 3)
    assert (row["value"], row["sigma"]) == (0.1, 0.01)
    assert str(row["taken_at"]) == "2023-11-14 22:13:23"
    buses = read_table(folder, "buses")
    assert len(buses) == 5 * sum(len(content.area.network.buses) for content in AREAS)
    assert {row["vm_kv"] for row in buses} == {bus.base_kv for bus in AREAS[0].area.network.buses}
    assert len(read_table(folder, "branches")) == 5 * sum(len(content.area.network.branches) for content in AREAS)
    event = read_table(folder, "events")[0]
    assert (event["event"], event["name"]) == ("appeared", "area1")
    assert not list((folder / LOGS).iterdir())


def test_a_recording_without_area_files_has_all_but_flows(tmp_path: Path) -> None:
    from coordinator.watch.recording.recorder import Recorder
    from coordinator.watch.recording.segment_log import SegmentLog

    with begin_writing(tmp_path, "grid"):
        log = SegmentLog(tmp_path)
        Recorder(log, "grid").take(_scans(1))
        log.close()
    close_ended(tmp_path)
    rows = read_table(tmp_path, "buses")
    assert {row["vm_pu"] for row in rows} == {1.0}
    assert {row["vm_kv"] for row in rows} == {None}
    assert not read_table(tmp_path, "branches")


def test_the_last_state_of_a_scan_alone_is_final(record: Record) -> None:
    content = AREAS[0]
    states = [
        make_state(content, 1, 1, quality="degraded", notes=("area2 is gone",)),
        make_state(content, 1, 1),
        make_state(content, 1, 2, vm=(0.5,) * len(content.area.network.buses)),
        make_state(content, 2, 3),
    ]
    folder = record([entry_of(state, AT + k) for k, state in enumerate(states)])
    close_ended(folder)
    shown = [(r["scan"], r["quality"], r["estimate"], r["final"]) for r in read_table(folder, "states")]
    assert shown == [(1, "degraded", 1, False), (1, "good", 1, False), (1, "good", 2, True), (2, "good", 3, True)]
    bus = content.area.network.buses[0].id
    voltages = [(r["estimate"], r["vm_pu"], r["final"]) for r in read_table(folder, "buses") if r["bus"] == bus]
    assert voltages == [(1, 1.0, False), (2, 0.5, True), (3, 1.0, True)]


def test_angles_that_count_from_nowhere_are_not_known(record: Record) -> None:
    folder = record([entry_of(make_state(AREAS[0], referenced=False))])
    close_ended(folder)
    assert {row["va_deg"] for row in read_table(folder, "buses")} == {None}


def test_hours_are_files_of_their_own(record: Record) -> None:
    folder = record([*_scans(2), *_scans(2, AT + HOUR), *_scans(2, AT + 3 * HOUR)])
    assert len(list_segments(folder)) == 3
    close_ended(folder)
    assert list_segments(folder) == ["20231114T221321-000", "20231114T231321-000", "20231115T011321-000"]
    assert len(read_table(folder, "states")) == 3 * 2 * len(AREAS)


def test_closing_that_was_broken_off_is_done_again(record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = record(_scans(3))
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", lambda *_, **__: (_ for _ in ()).throw(OSError(5, "Input/output error")))
        with pytest.raises(OSError, match="Input/output"):
            close_ended(folder)
    assert len(list((folder / LOGS).iterdir())) == 1
    close_ended(folder)
    assert len(read_table(folder, "states")) == 3 * len(AREAS)
    assert not list((folder / LOGS).iterdir())


def test_two_who_close_at_once_do_not_take_a_log_from_each_other(record: Record) -> None:
    folder = record([entry for hour in range(4) for entry in _scans(5, AT + hour * HOUR)])
    with ThreadPoolExecutor(3) as pool:
        closing_at_once = [pool.submit(close_ended, folder) for _ in range(3)]
    assert [done.result() for done in closing_at_once] == [[], [], []]
    assert len(read_table(folder, "states")) == 4 * 5 * len(AREAS)


def test_a_log_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    from coordinator.watch.recording.segment_log import SegmentLog

    with begin_writing(tmp_path, "grid"):
        log = SegmentLog(tmp_path)
        log.write([note(AT, "begun")])
        close_ended(tmp_path)
        remove_oldest(tmp_path, 0.0)
        assert len(list((tmp_path / LOGS).iterdir())) == 1
        log.close()


def test_a_damaged_log_loses_what_is_damaged_and_says_so(record: Record) -> None:
    folder = record(_scans(4))
    (path,) = (folder / LOGS).iterdir()
    content = bytearray(path.read_bytes())
    content[content.index(MARK, len(content) // 2) + 20] ^= 1  # in the second half one frame
    path.write_bytes(content[:-3])  # and the last, which was not written to its end
    assert close_ended(folder) == []
    rows = len(read_table(folder, "states")) + len({(r["area"], r["scan"]) for r in read_table(folder, "readings")})
    assert rows == 2 * 4 * len(AREAS) - 2
    details = [row["details"] for row in read_table(folder, "events") if row["event"] == "damaged log"]
    assert ["frames are damaged" in text for text in map(str, details)] == [True, False]


def test_a_foreign_file_among_the_logs_is_named_and_stays(record: Record) -> None:
    folder = record(_scans(1))
    (folder / LOGS / "notes.log").write_text("what I saw today\n")
    (details,) = close_ended(folder)
    assert "notes.log" in details
    assert "is no log of a recording" in details
    assert [path.name for path in (folder / LOGS).iterdir()] == ["notes.log"]
    assert len(read_table(folder, "states")) == len(AREAS)


def test_without_pyarrow_the_logs_stay_and_it_is_reported(record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = record(_scans(1))
    monkeypatch.setattr(closing, "has_parquet", lambda: False)
    assert [event.split(";")[0] for event in close_ended(folder)] == [NO_PARQUET]
    assert len(list((folder / LOGS).iterdir())) == 1


def test_the_oldest_hours_go_first_and_the_rest_keeps_the_limit(record: Record) -> None:
    folder = record([entry for hour in range(6) for entry in _scans(20, AT + hour * HOUR)])
    close_ended(folder)
    segments = list_segments(folder)
    sizes = {name: sum(path.stat().st_size for path in closing.files_of(folder, name)) for name in segments}
    limit = sum(sizes.values()) - sizes[segments[0]] - 1
    assert remove_oldest(folder, limit) == segments[:2]
    assert list_segments(folder) == segments[2:]
    assert remove_oldest(folder, limit) == []


def test_an_hour_that_fills_its_share_of_the_limit_ends_early(tmp_path: Path) -> None:
    from coordinator.watch.recording.segment_log import SegmentLog

    with begin_writing(tmp_path, "grid"):
        log = SegmentLog(tmp_path, limit=8 * 10_000)
        for k in range(100):
            log.write([note(AT + k, "filler", text="x" * 1000)])
        log.close()
    sizes = [path.stat().st_size for path in (tmp_path / LOGS).iterdir()]
    assert len(sizes) == 10
    assert max(sizes) < 12_000


def test_a_value_that_is_not_known_is_null_in_a_file(record: Record) -> None:
    nothing: dict[str, object] = dict.fromkeys(("buses", "vm", "va", "sigma_vm", "sigma_va"), ())
    folder = record([entry_of(make_state(AREAS[0], quality="none", **nothing))])
    close_ended(folder)
    (row,) = read_table(folder, "states")
    assert row["objective"] is None
    assert row["estimated"] is False
    assert not read_table(folder, "buses")


def test_what_parquet_holds_reads_back_to_the_bit(record: Record) -> None:
    folder = record([entry_of(make_readings(AREAS[0]))])
    close_ended(folder)
    (path,) = (folder / "readings").iterdir()
    rows = list(parquet.read_rows(path, ["meter", "value", "taken_at", "measured_at"]))
    message = make_readings(AREAS[0])
    assert [row[:2] for row in rows] == list(zip(message.meters, message.values, strict=True))
    assert {row[2:] for row in rows} == {(AT, AT - 0.5)}
    path.write_bytes(bytes(100))
    with pytest.raises(InvalidInputError, match="is no table of a recording"):
        list(parquet.read_rows(path, ["meter"]))
