"""The folder of one run: its path, and the check that it is new or empty."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from dsse_core.errors import InvalidInputError

PARTS = ("areas", "logs")
EVENTS = "events.jsonl"
RECORDING = "recording"  # folder, where the scenario asks for one


def make_run_folder(out: str | Path | None, name: str, inside: Sequence[str] = ()) -> Path:
    """Make folder ``out``, or ``runs/<name>-<time>``, and the folders ``inside`` it.

    Raises:
        InvalidInputError: ``out`` holds something already, or cannot be made.
    """
    folder = Path(out) if out is not None else Path("runs")
    try:
        if out is None:
            folder = _find_free(folder, f"{name[:100]}-{time.strftime('%Y%m%d-%H%M%S')}")
        folder.mkdir(parents=True, exist_ok=True)
        occupied = any(folder.iterdir())
        if not occupied:
            occupied = not all(_is_made(folder / part) for part in inside)
    except OSError as error:
        raise folder_error(f"run folder {folder}", error) from None
    if occupied:
        raise InvalidInputError(f"run folder {folder}", ["is not empty; choose a new one, or remove its content"])
    return folder


@contextmanager
def result_folder(out: Path) -> Iterator[Path]:
    """Folder ``out``, new or empty, for the results of the block; after an error, empty folders made here are removed.

    Raises:
        InvalidInputError: as ``make_run_folder``.
    """
    made = [place for place in (out, *out.parents) if not place.exists()]
    try:
        yield make_run_folder(out, "")
    except BaseException:
        for place in made:
            with suppress(OSError):  # never made, or not empty
                place.rmdir()
        raise


def describe_missing(folder: Path, name: str) -> str:
    """Words for the error that file ``name`` is not in ``folder``; empty where it is, or cannot be looked for."""
    try:
        (folder / name).stat()
    except (FileNotFoundError, NotADirectoryError):
        return f"no {name} is in it" if folder.is_dir() else "there is no such folder"
    except (OSError, ValueError):
        return ""
    return ""


def _is_made(folder: Path) -> bool:
    """Make ``folder``; False where another process has just made it."""
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    return True


def folder_error(what: str, error: OSError) -> InvalidInputError:
    """Error that the folder ``what`` cannot be made or read, with the reason."""
    in_the_way = isinstance(error, FileExistsError | NotADirectoryError)
    reason = "a file is in its way" if in_the_way else error.strerror
    return InvalidInputError(what, [f"cannot be made: {reason}; choose another place"])


def _find_free(parent: Path, name: str) -> Path:
    """``parent/name``, or with -2, -3 ... appended; made at once, so that no other run uses it."""
    parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        folder = parent / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1
