"""The folder of a recording: its order, layout and run, and the lock that lets a single recorder write it.

``recording.json`` names the run, ``areas/`` holds the area files where they are known, ``log/`` the logs, and
``states/``, ``buses/`` and so on the closed tables. A *segment*, of an hour or less, has one log, and after closing one
file in each folder of tables with rows. All its files have the same name: the time at which the segment began.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from agents.area_files.area_file import save_area_file
from agents.messages.checks import shown
from agents.protocol.configuration import Configuration
from coordinator.watch.recording.row_checks import AnyName
from coordinator.watch.run_folder import RECORDING, describe_missing
from dsse_core import operating_system
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import read_text
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.files.drafts import whole_file

ABOUT, AREAS, LOGS = "recording.json", "areas", "log"
TABLES = ("states", "buses", "branches", "readings", "events")
LOG, PARQUET = ".log", ".parquet"
FORMAT = 1
RECORDER = "recorder"  # the process of a run
GIB = 2**30  # bytes


@dataclass(frozen=True)
class RecordingOrder:
    """The order to a recorder.

    ``files``: area files, where known. ``limit_gb``: largest size of the folder, GiB; None: no limit. ``closes``: the
    recorder itself closes the last segments at its end.
    """

    folder: Path
    run: str
    files: Sequence[Configuration] = ()
    limit_gb: float | None = None
    closes: bool = True

    @property
    def limit(self) -> float | None:
        """Largest size of the folder, bytes; None: no limit."""
        return self.limit_gb * GIB if self.limit_gb else None


@dataclass(frozen=True, slots=True)
class About:
    """The run of a recording. ``areas``: names of the areas whose files are in the recording; empty without files."""

    run: AnyName
    areas: tuple[AnyName, ...]


def name_segment(at: float) -> str:
    """The name of a segment that begins at ``at``, s since 1970. The order of names is the order of times."""
    return datetime.fromtimestamp(at, UTC).strftime("%Y%m%dT%H%M%S-%f")[:-3]


def log_of(folder: Path, segment: str) -> Path:
    return folder / LOGS / f"{segment}{LOG}"


def table_of(folder: Path, table: str, segment: str) -> Path:
    return folder / table / f"{segment}{PARQUET}"


def list_segments(folder: Path) -> list[str]:
    """The names of all segments, the oldest first."""
    logs = (folder / LOGS).glob(f"*{LOG}")
    tables = (path for table in TABLES for path in (folder / table).glob(f"*{PARQUET}"))
    return sorted({path.stem for path in (*logs, *tables) if not path.name.startswith(".")})


def read_about(folder: Path) -> About:
    """The run and the areas of the recording in ``folder``.

    Raises:
        InvalidInputError: ``folder`` is no recording.
    """
    path = folder / ABOUT
    if missing := describe_missing(folder, ABOUT):
        problem = f"{missing}; give a folder that `dsse record` has written, or {RECORDING} in a run folder"
        raise InvalidInputError(f"recording {folder}", [problem])
    try:
        content = parse_json(read_text(path))
        if content["format"] != FORMAT:
            found = shown(content["format"])
            raise InvalidInputError(str(path), [f"has format {found}; this version reads {FORMAT}"])
        return msgspec.convert(content, About)
    except (ValueError, KeyError, TypeError, msgspec.ValidationError) as error:
        why = str(error) if isinstance(error, msgspec.ValidationError) else "it"
        problem = f"does not say of which run this is ({why}); give a folder that `dsse record` has written"
        raise InvalidInputError(str(path), [problem]) from None


def load_areas(folder: Path) -> list[Configuration]:
    """The area files of the recording in ``folder``, in the scenario's order; none where they are not known.

    Raises:
        InvalidInputError: ``folder`` is no recording, or an area file cannot be read or is that of another area.
    """
    from agents.area_files.reader import load_area_file  # its schema takes time to build; a recorder needs it rarely

    files = []
    for name in dict.fromkeys(read_about(folder).areas):
        path = folder / AREAS / f"{name}.json"
        content = load_area_file(path)
        if content.area.name != name:
            raise InvalidInputError(str(path), [f"is the file of area {content.area.name}; put that of {name} here"])
        files.append(content)
    return files


@contextmanager
def begin_writing(folder: Path, run: str, files: Sequence[Configuration] = ()) -> Iterator[None]:
    """Makes ``folder``, or goes on with the recording of ``run`` there. No other recorder writes there in the block.

    Raises:
        InvalidInputError: the folder holds something else, or another recorder writes there.
        OSError: the folder cannot be written.
    """
    for part in (LOGS, *TABLES):
        (folder / part).mkdir(parents=True, exist_ok=True)
    path = folder / ABOUT
    names = [content.area.name for content in files]
    with _locked(folder):
        if path.exists():
            _check_same(folder, run, files)
        elif list_segments(folder):
            problem = f"holds tables of a recording, but no {ABOUT}; put it back, or choose a new folder"
            raise InvalidInputError(str(folder), [problem])
        else:
            _save_areas(folder, files)
            about = {"format": FORMAT, "run": run, "areas": names, "begun": time.strftime("%FT%TZ", time.gmtime())}
            with whole_file(path) as draft:
                draft.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
        yield


def _save_areas(folder: Path, files: Sequence[Configuration]) -> None:
    if files:
        (folder / AREAS).mkdir(exist_ok=True)
    for content in files:
        save_area_file(folder / AREAS / f"{content.area.name}.json", content)


def _check_same(folder: Path, run: str, files: Sequence[Configuration]) -> None:
    about = read_about(folder)
    if about.run != run:
        problem = f"is a recording of run {about.run!r}, not of {run!r}; choose a new folder"
        raise InvalidInputError(str(folder), [problem])
    if files and load_areas(folder) != list(files):
        problem = "is a recording of other areas than the scenario has now; choose a new folder"
        raise InvalidInputError(str(folder), [problem])


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Locks the folder for this process. The system releases the lock when the process ends for any reason.

    Raises:
        InvalidInputError: another process holds the lock.
    """
    lock = os.open(folder, os.O_RDONLY)
    try:
        try:
            operating_system.lock(lock)
        except BlockingIOError:
            problem = "another recorder writes here; stop it, or choose another folder"
            raise InvalidInputError(str(folder), [problem]) from None
        except OSError:
            pass  # a system of files without locks
        yield
    finally:
        os.close(lock)
