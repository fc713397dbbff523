"""Foreign recordings: each malformed kind ends in one line that names file, row or frame, and field."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import warnings
import zlib
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from coordinator.cli.main import run_command
from coordinator.lab.stages.play import play_on_simulator
from coordinator.show.web.playback.source import play_recording
from coordinator.watch.recording import frames
from coordinator.watch.recording.closing import close_ended
from coordinator.watch.recording.frames import MAGIC, MARK, frame
from coordinator.watch.recording.recorded_tables import COLUMNS
from coordinator.watch.recording.row_checks import TYPES
from coordinator.watch.replay import recorded_messages, ticks
from coordinator.watch.replay.replay import find_hole
from coordinator.watch.replay.ticks import Tick, read_ticks
from dsse_core.errors import InvalidInputError
from tests.support.dsse_command import ENVIRONMENT, ROOT
from tests.support.malformed import (
    BOMBS,
    FILE_KINDS,
    HOSTILE_KINDS,
    LOG_KINDS,
    REFUSED_KINDS,
    SCANS,
    TABLE_KINDS,
    add_frame,
    log_in,
    rewrite,
    table_in,
    write_good,
)


@pytest.fixture(scope="session")
def good_recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """One good recording as a log, and one closed."""
    place = tmp_path_factory.mktemp("recordings")
    return {closed: write_good(place / str(closed), closed=closed) for closed in (False, True)}


def read_all(folder: Path) -> tuple[list[Tick], set[str]]:
    """What a replay reads, and the notes of the replay and of the page, each of which is one line."""
    notes: list[str] = []
    ticks = list(read_ticks(folder, notes))
    of_page: list[str] = []
    with suppress(InvalidInputError):  # nothing is left to play, as its notes say
        play_recording(folder, None, of_page)
    assert not any("\n" in note for note in (*notes, *of_page))
    assert len(notes) <= 1
    assert len(of_page) <= 1
    return ticks, {*notes, *of_page}


def test_the_good_recordings_have_no_note(good_recordings: dict[bool, Path]) -> None:
    for folder in good_recordings.values():
        ticks, notes = read_all(folder)
        assert [tick.scan for tick in ticks] == [*range(1, SCANS + 1)]
        assert not notes


def test_every_column_that_is_read_back_has_a_type_of_the_wire() -> None:
    for needed in (ticks.NEEDED, recorded_messages.NEEDED):
        for table, columns in needed.items():
            assert {*columns} <= TYPES[table].keys() <= COLUMNS[table].keys()


@pytest.mark.parametrize("kind", LOG_KINDS)
def test_a_malformed_frame_is_one_line_and_costs_nothing_else(
    tmp_path: Path, good_recordings: dict[bool, Path], kind: str
) -> None:
    folder = shutil.copytree(good_recordings[False], tmp_path / "r")
    make, found = LOG_KINDS[kind]
    add_frame(make, folder)
    path = log_in(folder)
    ticks, notes = read_all(folder)
    assert [tick.scan for tick in ticks] == [*range(1, SCANS + 1)]
    assert all(len(tick.readings) == len(tick.estimates) == 3 for tick in ticks)
    (note,) = notes
    assert note.startswith(str(path))
    assert re.search(found, note)
    assert close_ended(folder) == []  # and then it stands in the tables
    (again,) = read_all(folder)[1]
    assert again.startswith(str(folder / "events"))
    assert re.search(found, again)


@pytest.mark.parametrize("kind", TABLE_KINDS)
def test_a_malformed_row_is_one_line(tmp_path: Path, good_recordings: dict[bool, Path], kind: str) -> None:
    folder = shutil.copytree(good_recordings[True], tmp_path / "r")
    table, change, found = TABLE_KINDS[kind]
    rewrite(table, change, folder)
    _, (note, *others) = read_all(folder)
    assert not others
    assert note.startswith(str(table_in(folder, table)))
    assert re.search(found, note)


def test_a_table_without_rows_is_one(tmp_path: Path, good_recordings: dict[bool, Path]) -> None:
    folder = shutil.copytree(good_recordings[True], tmp_path / "r")
    for table in ("readings", "states", "buses", "events"):
        rewrite(table, lambda rows: rows.slice(0, 0), folder)
    assert read_all(folder) == ([], set())


@pytest.mark.parametrize("kind", HOSTILE_KINDS)
def test_numbers_that_the_bus_allows_are_played_without_a_warning(
    tmp_path: Path, good_recordings: dict[bool, Path], kind: str
) -> None:
    folder = shutil.copytree(good_recordings[True], tmp_path / "r")
    rewrite(*HOSTILE_KINDS[kind], folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ticks, notes = read_all(folder)
        assert not notes
        assert {tick.scan for tick in ticks} >= {*range(1, SCANS + 1)}
        source = play_recording(folder, None, [])
        assert all(source.frame(k) for k in range(len(source.times())))
        assert not any(find_hole(tick, [*tick.readings]) for tick in ticks if tick.readings)


@pytest.mark.parametrize("kind", FILE_KINDS)
def test_a_file_that_is_none_is_one_line_at_once(tmp_path: Path, good_recordings: dict[bool, Path], kind: str) -> None:
    closed, change, found = FILE_KINDS[kind]
    folder = shutil.copytree(good_recordings[closed], tmp_path / "r")
    change(folder)
    _, notes = read_all(folder)
    assert all(re.search(found, note) for note in notes)
    assert notes
    assert len(close_ended(folder)) == (not closed)


@pytest.mark.parametrize("kind", REFUSED_KINDS)
def test_a_recording_that_does_not_say_whose_it_is_is_one_error(
    tmp_path: Path, good_recordings: dict[bool, Path], kind: str
) -> None:
    folder = shutil.copytree(good_recordings[True], tmp_path / "r")
    change, found = REFUSED_KINDS[kind]
    change(folder)
    for read in (lambda: play_on_simulator(folder), lambda: play_recording(folder, None, [])):
        with pytest.raises(InvalidInputError, match=found) as caught:
            read()
        assert len(caught.value.problems) == 1


MEASURE = """
import sys
from contextlib import suppress
from pathlib import Path
from dsse_core.errors import InvalidInputError
from coordinator.watch.replay.ticks import read_ticks
from coordinator.show.web.playback.source import play_recording

def read(folder):
    notes = []
    list(read_ticks(Path(folder), notes))
    with suppress(InvalidInputError):  # nothing is left to play, as its notes say
        play_recording(Path(folder), None, notes)
    return notes

def find_most_memory():
    return int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])

good, *others = sys.argv[1:]
assert not read(good)
before = find_most_memory()
for folder in others:
    print(" ".join(read(folder)))
print(find_most_memory() - before)
"""


def test_small_tables_that_expand_to_gigabytes_are_refused_within_200_mib(
    tmp_path: Path, good_recordings: dict[bool, Path]
) -> None:
    folders = {kind: shutil.copytree(good_recordings[True], tmp_path / kind) for kind in BOMBS}
    for kind, folder in folders.items():
        table, write, _ = BOMBS[kind]
        write(path := table_in(folder, table))
        assert path.stat().st_size < 500_000
    command = [sys.executable, "-c", MEASURE, str(good_recordings[True]), *map(str, folders.values())]
    run = subprocess.run(command, env=ENVIRONMENT, cwd=ROOT, capture_output=True, text=True, check=True)
    *notes, grown = run.stdout.splitlines()
    for note, (kind, folder) in zip(notes, folders.items(), strict=True):
        table, _, found = BOMBS[kind]
        assert note.startswith(str(table_in(folder, table)))
        assert re.search(found, note)
    assert int(grown) < 200 * 1024  # KiB


def test_a_log_of_nothing_but_beginnings_of_frames_costs_linear_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each beginning states the longest body that is left: searched through to the end, they cost the square."""
    count, searched = 2_000, 0
    monkeypatch.setattr(frames, "MOST_SEARCHED", 0)
    head = len(frame(b""))
    bodies = [MARK + (head * (count - k - 1)).to_bytes(4, "big") + bytes(4) for k in range(count)]
    (tmp_path / "a.log").write_bytes(MAGIC + b"".join(bodies))

    def crc32(content: bytes, start: int = 0) -> int:
        nonlocal searched
        searched += len(content)
        return zlib.crc32(content, start)

    monkeypatch.setattr(frames, "zlib", SimpleNamespace(crc32=crc32))
    (gap,) = frames.read_frames(tmp_path / "a.log")
    assert isinstance(gap, frames.Gap)
    assert searched < 4 * head * count


@pytest.mark.parametrize("command", [["replay"], ["serve", "--listen", "127.0.0.1:0", "--recording"]])
def test_a_command_ends_with_the_notes_and_no_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    folder = write_good(tmp_path / "r", closed=True)
    for table in ("readings", "states"):
        rewrite(table, lambda rows: rows.drop_columns(["scan"]), folder)
    table_in(folder, "events").unlink()
    assert run_command([*command, str(folder)]) == 2
    shown = capsys.readouterr().err
    assert "column scan is there 0 times" in shown
    assert "Traceback" not in shown
