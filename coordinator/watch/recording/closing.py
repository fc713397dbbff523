"""Closing: the logs of ended segments become Parquet. ``python -m coordinator.watch.recording.closing FOLDER``.

The process that finds a log unlocked closes it: a process beside the recorder at the end of a segment, or the closing
process of the next recorder if the recorder was killed. A log is removed only when all its tables are on the disk, so
that closing can be interrupted at any point.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from agents.runtime.log import start_log
from coordinator.watch.recording.entries import read_entries
from coordinator.watch.recording.folder import (
    LOG,
    LOGS,
    TABLES,
    list_segments,
    load_areas,
    log_of,
    read_about,
    table_of,
)
from coordinator.watch.recording.frames import is_being_written
from coordinator.watch.recording.parquet import has_parquet, sync_path, write_rows
from coordinator.watch.recording.recorded_tables import Row, RowMaker
from dsse_core import operating_system
from dsse_core.errors import DsseError, InvalidInputError
from dsse_core.files.drafts import draft_folder, remove_leftovers
from dsse_core.files.installation import install_command

log = logging.getLogger(__name__)
NICE = 10
ROOT = Path(__file__).resolve().parents[3]  # where this package was imported from
NO_PARQUET = "pyarrow is not installed, so logs are not closed into Parquet"


def close_ended(folder: Path) -> list[str]:
    """Closes every log in ``folder`` that no recorder writes. Returns notes for the user, on files that stay as logs.

    Raises:
        OSError: ``folder`` has no folder of logs, or the tables cannot be written; the log stays.
    """
    with _closing_alone(folder):
        ended = [path for path in _list_logs(folder) if not is_being_written(path)]
        if not ended:
            return []
        if not has_parquet():
            return [f"{NO_PARQUET}; {install_command('parquet')}"]
        remove_leftovers(folder)
        notes = []
        for path in ended:
            try:
                _close(folder, path.stem)
            except InvalidInputError as error:  # a foreign file; the others are closed all the same
                notes.append(str(error))
        return notes


@contextmanager
def _closing_alone(folder: Path) -> Iterator[None]:
    """Waits until no other process closes logs in ``folder``: the closing process of a killed recorder goes on."""
    lock = os.open(folder / LOGS, os.O_RDONLY | operating_system.FLAG_NO_WAIT)
    try:
        with suppress(OSError):  # a system of files without locks
            operating_system.lock(lock, wait=True)
        yield
    finally:
        os.close(lock)


def close_recording(folder: Path) -> None:
    """Closes the recording of a run. Logs notes and errors, because the run does not fail for them."""
    try:
        notes = close_ended(folder)
    except (DsseError, OSError) as error:
        notes = [str(error)]
    for text in notes:
        log.warning("recording %s: %s", folder, text)


def _close(folder: Path, segment: str) -> None:
    """Writes the tables of ``segment``, and removes its log."""
    path = log_of(folder, segment)
    with draft_folder(folder) as draft:
        for table in write_rows(rows_of_log(folder, segment), draft):
            target = table_of(folder, table, segment)
            target.parent.mkdir(exist_ok=True)
            (draft / f"{table}.parquet").replace(target)
            sync_path(target.parent)
    path.unlink(missing_ok=True)


def rows_of_log(folder: Path, segment: str) -> Iterator[Row]:
    """The rows of all tables in the log of ``segment``, in order.

    Raises:
        InvalidInputError: the log cannot be read or is no log, or ``folder`` is no recording.
    """
    maker = RowMaker(read_about(folder).run, load_areas(folder))
    for number, entry in enumerate(read_entries(log_of(folder, segment)), 1):
        yield from maker.rows_of(entry, f"frame {number}: ")
    yield from maker.finish()


def remove_oldest(folder: Path, limit: float) -> list[str]:
    """Removes the oldest segments in ``folder`` until all together have ``limit`` bytes at most, except a segment that
    is being written. Returns the names of the removed segments.
    """
    sizes = {segment: sum(map(_size_of, files_of(folder, segment))) for segment in list_segments(folder)}
    left, removed = sum(sizes.values()), []
    for segment, size in sizes.items():
        if left <= limit:
            break
        if is_being_written(log_of(folder, segment)):
            continue
        for path in files_of(folder, segment):
            path.unlink(missing_ok=True)
        left -= size
        removed.append(segment)
    return removed


def files_of(folder: Path, segment: str) -> list[Path]:
    """The existing files of a segment: its log and its tables."""
    paths = (log_of(folder, segment), *(table_of(folder, table, segment) for table in TABLES))
    return [path for path in paths if path.exists()]


def _list_logs(folder: Path) -> list[Path]:
    return sorted(path for path in (folder / LOGS).glob(f"*{LOG}") if not path.name.startswith("."))


def _size_of(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


class Closer:
    """Closes ended segments of ``folder`` in a process beside the recorder, which must not wait for it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self._is_asked = False

    def ask(self) -> None:
        """Asks to close the segments that have ended."""
        self._is_asked = True
        self.check()

    def check(self) -> None:
        """Starts the closing that was asked for, unless one is under way."""
        if self._process is not None and self._process.poll() is None:
            return
        self._process = None
        if self._is_asked:
            self._is_asked = False
            path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "coordinator.watch.recording.closing", str(self._folder)],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is the recorder's business
                env={**os.environ, "PYTHONPATH": path},
            )

    def wait(self) -> None:
        """Waits for the closing under way."""
        if self._process is not None:
            self._process.wait()


def main(arguments: Sequence[str]) -> int:
    """Closes the ended segments in the folder ``arguments[0]``. Returns 0, or 2 after an error, which is logged."""
    start_log()
    operating_system.be_nice(NICE)
    try:
        for text in close_ended(Path(arguments[0])):
            log.warning("%s", text)
    except (DsseError, OSError) as error:
        log.error("closing %s: %s", arguments[0], error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
