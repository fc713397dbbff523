"""The table of a sweep, ``sweep.csv``: a row per run, written when the run ends. A later sweep continues the table.

At the end of a sweep the rows are sorted.

``sweep.json`` beside it holds the settings common to all rows, so that rows of different settings never mix.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from coordinator.lab.studies.study_row import COLUMNS, StudyRow, describe_versions, from_cells, to_cells
from coordinator.lab.studies.sweep_plan import Task, number_of, sorted_tasks, text_of
from coordinator.watch.run_folder import folder_error
from dsse_core import operating_system
from dsse_core.errors import InvalidInputError
from dsse_core.files.bounded_file import open_regular, read_text
from dsse_core.files.bounded_parsing import parse_json
from dsse_core.files.drafts import remove_leftovers, whole_file
from dsse_core.files.whole_lines import WholeLines
from scenarios.files.key_values import parse_value

TABLE, SETTINGS = "sweep.csv", "sweep.json"
ANOTHER = "choose another --out, or repeat the sweep as it was"


class SweepTable:
    """The rows of a sweep so far, task -> row, and their file.

    Args:
        folder: new, empty, or that of an earlier sweep with the same ``settings``.

    Raises:
        InvalidInputError: the folder holds something else, or another process writes there.
    """

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self.path = folder / TABLE
        self.rows: dict[Task, StudyRow] = {}
        self.cut_off = False  # True where the last line was incomplete; its run is repeated
        self._origin = (describe_versions(), str(settings["scenario_sha256"]))
        self._keys: list[list[str]] = settings["vary"]
        self._header = [*(key for keys in self._keys for key in keys), *COLUMNS]
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise folder_error(f"sweep folder {folder}", error) from None
        remove_leftovers(folder)
        _check_settings(folder, settings)
        if self.path.exists():
            _check_regular(self.path)
        self._lines = WholeLines(self.path)
        try:
            operating_system.lock(self._lines.file.fileno())
            if not os.path.samestat(os.fstat(self._lines.file.fileno()), self.path.stat()):  # sorted meanwhile
                raise BlockingIOError
        except BlockingIOError:
            self._lines.close()
            raise InvalidInputError(str(self.path), ["another sweep is writing to it; wait for its end"]) from None
        except OSError:
            pass  # a system of files without locks
        try:
            self._read()
        except InvalidInputError:
            self._lines.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.rows:
            self._sort()
        self._lines.close()

    def _sort(self) -> None:
        """Replaces the file by one with sorted rows; whoever is killed meanwhile leaves one of the two."""
        tasks = sorted_tasks(self.rows)
        if tasks == list(self.rows):
            return
        self.rows = {task: self.rows[task] for task in tasks}
        with whole_file(self.path) as draft:
            draft.write_text("".join(map(_write_line, [self._header, *map(self._cells, tasks)])), encoding="utf-8")

    def add(self, task: Task, row: StudyRow) -> None:
        """Adds the row of a run that has ended, and writes it to the file."""
        self.rows[task] = row
        self._lines.append(_write_line(self._cells(task)))

    def list_rows(self) -> list[dict[str, Any]]:
        """The rows with the values of their keys, numbers as such, as ``--json`` prints them."""
        found = []
        for task, row in self.rows.items():
            values = [text if (number := number_of(text)) is None else number for text in task.values]
            of_keys = {key: value for keys, value in zip(self._keys, values, strict=True) for key in keys}
            found.append(of_keys | asdict(row))
        return found

    def _cells(self, task: Task) -> list[str]:
        of_keys = [text for keys, text in zip(self._keys, task.values, strict=True) for _ in keys]
        return [*of_keys, *to_cells(self.rows[task])]

    def _read(self) -> None:
        content = self._lines.read()
        whole = content[: content.rfind(b"\n") + 1]
        if whole != content:
            self.cut_off = True
            self._lines.cut_to(len(whole))
        try:
            lines = list(csv.reader(io.StringIO(whole.decode(), newline="")))
        except (UnicodeDecodeError, csv.Error) as error:
            raise InvalidInputError(
                str(self.path), [f"is no table that a sweep has written: {error}; {ANOTHER}"]
            ) from None
        if not lines:
            self._lines.append(_write_line(self._header))
            return
        if lines[0] != self._header:
            raise InvalidInputError(str(self.path), [f"has other columns than this sweep writes; {ANOTHER}"])
        problems = []
        n_key = len(self._header) - len(COLUMNS)
        firsts = [sum(map(len, self._keys[:k])) for k in range(len(self._keys))]  # of the keys of each axis
        for number, cells in enumerate(lines[1:], start=2):
            try:
                row = from_cells(cells[n_key:])
            except ValueError as error:
                problems.append(f"line {number} is no row of a sweep ({error}); remove it")
            else:
                if (row.versions, row.scenario_sha256) != self._origin:
                    problems.append(
                        f"line {number} is a row of {row.versions}, scenario {row.scenario_sha256[:12]}, and here are "
                        f"{self._origin[0]}, scenario {self._origin[1][:12]}; {ANOTHER}"
                    )
                values = tuple(text_of(parse_value(cells[k])) for k in firsts)
                self.rows[Task(values, row.strategy, row.seed)] = row
        if problems:
            raise InvalidInputError(str(self.path), problems)


def _write_line(cells: Sequence[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue()


def _check_regular(path: Path) -> None:
    """Checks that ``path`` is a regular file, which can be read to its end.

    Raises:
        InvalidInputError: it is not.
    """
    try:
        open_regular(path).close()
    except OSError as error:
        raise InvalidInputError(str(path), [f"cannot be read: {error.strerror}"]) from None


def _check_settings(folder: Path, settings: dict[str, Any]) -> None:
    """Compares ``settings`` with those of an earlier sweep in ``folder``; writes them if there was none.

    Raises:
        InvalidInputError: the settings differ, or the folder holds something else.
    """
    path = folder / SETTINGS
    if not path.exists():
        if any(folder.iterdir()):
            raise InvalidInputError(
                f"sweep folder {folder}", ["holds something that is no sweep; choose another --out"]
            )
        with whole_file(path) as draft:
            draft.write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")
        return
    try:
        found = parse_json(read_text(path))
    except ValueError as error:
        raise InvalidInputError(str(path), [f"is not as a sweep has written it: {error}; {ANOTHER}"]) from None
    there = found if isinstance(found, dict) else {}
    problems = [
        f"{key} is {there.get(key)!r} in the sweep there and {wanted!r} now; {ANOTHER}"
        for key, wanted in settings.items()
        if there.get(key) != wanted
    ]
    if problems:
        raise InvalidInputError(f"sweep folder {folder}", problems)
