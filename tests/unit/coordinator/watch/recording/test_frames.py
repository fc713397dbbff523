"""The log: what was written whole is read, whatever befell the rest of the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from coordinator.watch.recording.frames import LARGEST, MAGIC, FrameLog, Gap, frame, is_being_written, read_frames
from dsse_core.errors import InvalidInputError

BODIES = [b"first", b"", b"third" * 100, b"last"]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    log = FrameLog(tmp_path / "a.log")
    for body in BODIES:
        log.append([body])
    log.close()
    return log.path


def test_frames_come_back_in_order(path: Path) -> None:
    assert list(read_frames(path)) == BODIES


def test_a_log_cut_anywhere_loses_its_torn_frame_alone(path: Path) -> None:
    whole = path.read_bytes()
    ends = [len(MAGIC) + sum(len(frame(body)) for body in BODIES[:k]) for k in range(len(BODIES) + 1)]
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        *bodies, gap = [*read_frames(path), None]
        expected = sum(size >= end for end in ends[1:])
        if size > ends[0] and size not in ends:
            gap = bodies.pop()
            assert isinstance(gap, Gap)
            assert gap.is_end
            assert gap.at == ends[expected]
        assert bodies == BODIES[:expected]


@pytest.mark.parametrize("damaged", range(len(BODIES)))
def test_a_damaged_frame_is_named_and_nothing_else_is_lost(path: Path, damaged: int) -> None:
    content = bytearray(path.read_bytes())
    at = len(MAGIC) + sum(len(frame(body)) for body in BODIES[:damaged])
    for place in range(at, at + len(frame(BODIES[damaged]))):
        changed = bytearray(content)
        changed[place] ^= 0x5A
        path.write_bytes(changed)
        found = list(read_frames(path))
        assert found[damaged] == Gap(at, len(frame(BODIES[damaged])), damaged == len(BODIES) - 1)
        assert [body for body in found if isinstance(body, bytes)] == BODIES[:damaged] + BODIES[damaged + 1 :]


def test_a_mark_within_a_body_is_no_frame_of_its_own(tmp_path: Path) -> None:
    log = FrameLog(tmp_path / "a.log")
    log.append([frame(b"inner"), b"after"])
    log.close()
    assert list(read_frames(log.path)) == [frame(b"inner"), b"after"]


def test_a_length_beyond_all_bounds_is_not_believed(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_bytes(
        MAGIC + frame(b"x")[:4] + (LARGEST + 1).to_bytes(4, "big") + bytes(8) + frame(b"y")
    )
    gap, body = read_frames(tmp_path / "a.log")
    assert isinstance(gap, Gap)
    assert body == b"y"


def test_a_foreign_file_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_bytes(b"time,bus,vm\n1,2,3\n4,5,6\n")
    with pytest.raises(InvalidInputError, match=r"(?s)a\.log.*is no log of a recording: it begins with 'time,bus"):
        list(read_frames(tmp_path / "a.log"))


def test_an_empty_log_is_that_of_a_recorder_killed_at_once(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_bytes(b"")
    assert not list(read_frames(tmp_path / "a.log"))


def test_a_log_is_not_begun_where_one_is(path: Path) -> None:
    with pytest.raises(FileExistsError):
        FrameLog(path)


def test_a_log_that_is_being_written_is_seen_to_be(tmp_path: Path) -> None:
    log = FrameLog(tmp_path / "a.log")
    assert is_being_written(log.path)
    log.close()
    assert not is_being_written(log.path)
