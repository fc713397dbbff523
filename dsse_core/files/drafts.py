"""Files and folders under way, called drafts: a file stands under its name when it is whole, or not at all.

A draft is locked as long as the process that writes it lives, and the system releases the lock however that process
ends. The lock distinguishes a draft under way from one that a killed process has left.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from dsse_core import operating_system

DRAFT = ".dsse-new-"
RANDOM = "[0-9a-f]{16}"
PRIVATE_FOLDER = 0o700


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A draft to write, of the same ending; at the end of the block it replaces the file at ``path``.

    After any error ``path`` is as before.

    Raises:
        OSError: naming ``path``, where its folder cannot be written, or a disk is full.
    """
    try:
        with _locked(path.parent, DRAFT, path.suffix, _make_file) as draft:
            yield draft
            draft.replace(path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


@contextmanager
def draft_folder(parent: Path, prefix: str = DRAFT) -> Iterator[Path]:
    """A new folder in ``parent``, readable by its owner only, that is removed at the end of the block."""
    with _locked(parent, prefix, "", lambda path: path.mkdir(PRIVATE_FOLDER)) as folder:
        yield folder


def remove_leftovers(
    parent: Path, prefix: str = re.escape(DRAFT), is_used: Callable[[Path], bool] = lambda _: False
) -> None:
    """Removes the drafts in ``parent`` that ended processes of this user have left.

    ``prefix``: pattern of the beginning of their names. ``is_used``: True for a draft that is still needed. On a file
    system without locks nothing is removed.
    """
    name = re.compile(rf"{prefix}{RANDOM}(\.\w+)?")
    with contextlib.suppress(OSError):
        for path in [place for place in parent.iterdir() if name.fullmatch(place.name)]:
            with contextlib.suppress(OSError):
                _remove_if_left(path, is_used)


@contextmanager
def _locked(parent: Path, prefix: str, suffix: str, make: Callable[[Path], None]) -> Iterator[Path]:
    path, lock = _make_locked(parent, prefix, suffix, make)
    try:
        yield path
    finally:
        with contextlib.suppress(OSError):
            _remove(path)  # where the draft still is
        os.close(lock)


def _make_locked(parent: Path, prefix: str, suffix: str, make: Callable[[Path], None]) -> tuple[Path, int]:
    while True:
        path = parent / f"{prefix}{secrets.token_hex(8)}{suffix}"
        make(path)
        lock = os.open(path, os.O_RDONLY)
        with contextlib.suppress(OSError):  # a file system without locks
            operating_system.lock(lock)
        if path.exists():
            return path, lock
        os.close(lock)  # another process took the draft for a leftover before it was locked


def _make_file(path: Path) -> None:
    path.open("xb").close()


def _remove_if_left(path: Path, is_used: Callable[[Path], bool]) -> None:
    lock = os.open(path, os.O_RDONLY | operating_system.FLAGS_UNFOLLOWED)
    try:
        status = os.fstat(lock)
        if operating_system.is_own(status) and (stat.S_ISDIR(status.st_mode) or stat.S_ISREG(status.st_mode)):
            operating_system.lock(lock)  # OSError: its writer lives
            if not is_used(path):
                _remove(path)
    finally:
        os.close(lock)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()
