"""What a writer leaves behind: all of a file or nothing, and what a killed one leaves is removed by the next."""

from __future__ import annotations

import os
import resource
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dsse_core.files.drafts import DRAFT, draft_folder, remove_leftovers, whole_file
from dsse_core.files.whole_lines import WholeLines

WRITER = """
import sys, time
from pathlib import Path
from dsse_core.files.drafts import draft_folder, whole_file
make = whole_file if sys.argv[1] == "file" else draft_folder
with make(Path(sys.argv[2])) as draft:
    print("ready", flush=True)
    time.sleep(60)
"""


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """No file may grow beyond ``size`` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@contextmanager
def writer(kind: str, path: Path) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen([sys.executable, "-c", WRITER, kind, path], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def test_a_file_is_not_half_written_where_the_disk_is_full(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text("before")
    with pytest.raises(OSError, match=r"File too large: '.*result\.json'"), full_disk(100), whole_file(path) as draft:
        draft.write_text("x" * 1000)
    assert [file.name for file in tmp_path.iterdir()] == ["result.json"]
    assert path.read_text() == "before"


def test_an_interrupt_leaves_no_part_of_a_file(tmp_path: Path) -> None:
    def write_and_be_interrupted() -> None:
        with whole_file(tmp_path / "result.json") as draft:
            draft.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_and_be_interrupted()
    assert list(tmp_path.iterdir()) == []


def test_a_whole_file_has_the_rights_of_any_other(tmp_path: Path) -> None:
    (tmp_path / "other").touch()
    with whole_file(tmp_path / "one") as draft:
        draft.write_text("all")
    assert (tmp_path / "one").stat().st_mode == (tmp_path / "other").stat().st_mode
    with draft_folder(tmp_path) as folder:
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_a_killed_writer_leaves_is_removed_and_that_of_a_living_one_is_not(tmp_path: Path, kind: str) -> None:
    with writer(kind, tmp_path / "one" if kind == "file" else tmp_path) as process:
        (left,) = tmp_path.iterdir()
        remove_leftovers(tmp_path)
        assert left.exists()
        process.kill()
        process.wait()
        remove_leftovers(tmp_path, is_used=lambda _: True)
        assert left.exists()
        remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_nothing_else_is_taken_for_a_leftover(tmp_path: Path) -> None:
    hexadecimal = "0123456789abcdef"
    (tmp_path / "of another").mkdir()
    (tmp_path / f"{DRAFT}{hexadecimal}").symlink_to(tmp_path / "of another")
    os.mkfifo(tmp_path / f"{DRAFT}{hexadecimal}.json")
    (tmp_path / f"{DRAFT}my-notes").touch()
    before = sorted(tmp_path.iterdir())
    remove_leftovers(tmp_path)
    remove_leftovers(tmp_path / "nowhere")
    assert sorted(tmp_path.iterdir()) == before


def test_a_line_is_not_half_written_where_the_disk_is_full(tmp_path: Path) -> None:
    lines = WholeLines(tmp_path / "events.jsonl")
    lines.append("first\n")
    with full_disk(10), pytest.raises(OSError, match=r"File too large: '.*events\.jsonl'"):
        lines.append("second\n")
    lines.append("third\n")
    lines.close()
    assert (tmp_path / "events.jsonl").read_text() == "first\nthird\n"
