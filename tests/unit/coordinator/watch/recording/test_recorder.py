"""The recorder: what is new is written, once; what does not belong there is counted; a full disk ends nothing."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path

import pytest

from agents.messages.keys import state_key
from agents.messages.packing import encode
from coordinator.watch.recording.closing import rows_of_log
from coordinator.watch.recording.entries import MESSAGE, Entry, note, read_entries
from coordinator.watch.recording.folder import LOGS, begin_writing, list_segments, log_of, read_about
from coordinator.watch.recording.segment_log import SegmentLog
from dsse_core.errors import InvalidInputError
from tests.support.recordings import AT, RUN, Record, entry_of, load_areas_of, make_readings, make_state

AREAS = load_areas_of()


def _written(folder: Path) -> list[Entry | str]:
    return [entry for segment in list_segments(folder) for entry in read_entries(log_of(folder, segment))]


def test_repeats_are_written_now_and_then_only(record: Record) -> None:
    states = [entry_of(make_state(AREAS[0], at=AT + k), AT + 0.2 * k) for k in range(100)]
    assert len(_written(record(states))) == 2


def test_a_note_that_counts_seconds_is_no_news(record: Record) -> None:
    texts = [f"no telemetry for {k}.5 s" for k in range(20)]
    folder = record([entry_of(make_state(AREAS[0], notes=(text,)), AT + 0.1) for text in texts])
    assert len(_written(folder)) == 1


def test_the_same_number_of_a_restarted_area_is_news(record: Record) -> None:
    state = make_state(AREAS[0])
    later = replace(state, header=replace(state.header, incarnation=replace(state.header.incarnation, random=8)))
    assert len(_written(record([entry_of(state), entry_of(later)]))) == 2


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"garbage", "damaged"),
        (encode(replace(make_state(AREAS[1]))), "unknown sender"),
        (encode(replace(s := make_state(AREAS[0]), header=replace(s.header, run="other"))), "unknown sender"),
    ],
)
def test_what_does_not_belong_there_is_counted_and_nothing_else_is_lost(
    record: Record, payload: bytes, reason: str
) -> None:
    key = state_key(RUN, AREAS[0].area.name)
    false = [Entry(MESSAGE, AT, key, payload)] * 10
    written = _written(record([*false[:5], entry_of(make_readings(AREAS[0])), *false[5:]]))
    notes = [entry for entry in written if isinstance(entry, Entry) and entry.key == "rejected"]
    assert len(written) == 3
    assert f'"reason":"{reason}","count":10' in notes[-1].payload.decode()


def test_a_full_disk_loses_what_it_has_no_room_for_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    with begin_writing(tmp_path, RUN):
        log = SegmentLog(tmp_path)
        log.write([note(AT, "before")])

        def fill(file: int, content: bytes) -> int:
            write(file, bytes(content)[:7])
            raise OSError(errno.ENOSPC, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(os, "write", fill)
            log.write([note(AT, "during"), note(AT, "during")])
            log.write([note(AT, "during")])
        log.write([note(AT, "after")])
        log.close()
    entries = _written(tmp_path)
    assert [entry.key for entry in entries if isinstance(entry, Entry)] == ["before", "lost", "after"]
    assert b'"entries":3' in entries[1].payload  # type: ignore[union-attr]
    assert log.lost == 3


def test_a_disk_full_from_the_start_leaves_no_open_file_and_no_log_and_the_cause_is_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    files: list[int] = []

    def refuse(file: int, content: bytes) -> int:
        files.append(file)
        raise OSError(errno.ENOSPC, "No space left on device")

    with begin_writing(tmp_path, RUN):
        log = SegmentLog(tmp_path)
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", refuse)
            log.write([note(AT, "during")])
        with pytest.raises(OSError, match=os.strerror(errno.EBADF)):
            os.fstat(files[0])
        assert not list((tmp_path / LOGS).iterdir())
        assert "No space left on device; entries are lost" in caplog.text
        log.write([note(AT, "after")])
        log.close()
    assert [entry.key for entry in _written(tmp_path) if isinstance(entry, Entry)] == ["lost", "after"]


def test_two_recorders_do_not_write_into_one_folder(tmp_path: Path) -> None:
    with (
        begin_writing(tmp_path, RUN),
        pytest.raises(InvalidInputError, match="another recorder writes here"),
        begin_writing(tmp_path, RUN),
    ):
        pass


def test_another_run_gets_a_folder_of_its_own(tmp_path: Path) -> None:
    with begin_writing(tmp_path, RUN, AREAS):
        pass
    with (
        pytest.raises(InvalidInputError, match="recording of run 'grid', not of 'other'"),
        begin_writing(tmp_path, "other"),
    ):
        pass
    with pytest.raises(InvalidInputError, match="other areas"), begin_writing(tmp_path, RUN, AREAS[:-1]):
        pass
    with begin_writing(tmp_path, RUN, AREAS):  # a recorder that starts again goes on
        pass
    assert read_about(tmp_path).areas == ("area1", "area2", "area3")


def test_a_folder_that_is_no_recording_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"no recording\.json is in it; give a folder that `dsse record`"):
        read_about(tmp_path)
    with pytest.raises(InvalidInputError, match="there is no such folder"):
        read_about(tmp_path / "absent")
    (tmp_path / "recording.json").write_text("[1]")
    with pytest.raises(InvalidInputError, match="does not say of which run"):
        read_about(tmp_path)


def test_an_entry_of_another_version_is_one_event(record: Record) -> None:
    from coordinator.watch.recording.frames import frame

    folder = record([entry_of(make_state(AREAS[0]))])
    (path,) = (folder / LOGS).iterdir()
    path.write_bytes(path.read_bytes() + frame(b"\xc1"))
    rows = list(rows_of_log(folder, path.stem))
    assert any(table == "events" and "no entry of this version" in row[-1] for table, row in rows)
    assert any(table == "states" for table, _ in rows)
