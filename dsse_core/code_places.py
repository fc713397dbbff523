"""Places of compiled code: folders in which it is kept and from which it is loaded.

Loading compiled code runs it. It is never loaded from a place that another unprivileged user can write. This module
finds without numba which compiled code is there.

Places, in this order: the folder in NUMBA_CACHE_DIR alone, if that is set; else ``__pycache__`` beside this file, which
an administrator may have filled for all users, and ``dsse`` in the cache folder of the user. Code is loaded from the
first place that has it and kept in the first that can be written. Without any place each process compiles for itself.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import stat
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from dsse_core import operating_system
from dsse_core.errors import InvalidInputError

BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH
SOURCES = Path(__file__).resolve().parent
CODE = (".nbi", ".nbc", ".whole")  # numba's index and data files, and our notes
Whole = Literal["exchange", "estimate", "batch", "sparse"]
"""Code that is compiled together: steps of an area; an estimate and its bad data of a radial network; many of these,
and of power flows, at once; elimination in networks of any shape."""


@dataclass(frozen=True, slots=True)
class CodeFolder:
    """A folder for compiled code. ``fault``: the reason not to use it, as text; None where it is used."""

    folder: Path
    fault: str | None


@cache
def find_places() -> tuple[CodeFolder, ...]:
    """All places of compiled code, in the order of their use.

    Raises:
        InvalidInputError: NUMBA_CACHE_DIR is set to a place that others can write.
    """
    of_sources = f"{SOURCES.name}-{hashlib.sha256(os.fsencode(SOURCES)).hexdigest()[:32]}"  # of one installation
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        folder = Path(given).absolute() / of_sources
        if fault := find_fault(folder):
            cure = "make it writable by its owner only, or choose another folder"
            raise InvalidInputError("NUMBA_CACHE_DIR", [f"compiled code is not loaded from {folder}: {fault}; {cure}"])
        return (CodeFolder(folder.resolve(), None),)
    folders = [SOURCES / "__pycache__"]
    with contextlib.suppress(RuntimeError):  # no home
        of_user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folders.append(of_user.absolute() / "dsse" / of_sources)
    return tuple(CodeFolder(folder.resolve(), find_fault(folder)) for folder in folders)


def find_fault(folder: Path) -> str | None:
    """The reason why another user than root and that of this process may have put code into ``folder``, as text.

    None where no other user can have. Checked are the folder, all folders above it, and the compiled code in it. A path
    that does not exist yet is no fault; a path that cannot be read, or is neither folder nor file, is a fault.
    """
    if not operating_system.has_owners():
        return None  # Windows: permissions are not in these bits, and folders of users are theirs
    folder = folder.resolve()
    try:
        for path in (folder, *folder.parents):
            with contextlib.suppress(FileNotFoundError):
                status = path.lstat()
                # in a sticky folder above, users can rename only entries of their own
                sticky_above = path != folder and status.st_mode & stat.S_ISVTX
                if fault := _fault_of(path, status, stat.S_ISDIR, 0 if sticky_above else BY_OTHERS):
                    return fault
        with contextlib.suppress(FileNotFoundError), os.scandir(folder) as entries:
            for entry in entries:
                if entry.name.endswith(CODE):
                    status = entry.stat(follow_symlinks=False)
                    if fault := _fault_of(Path(entry.path), status, stat.S_ISREG, BY_OTHERS):
                        return fault
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    return None


def _fault_of(path: Path, status: os.stat_result, is_kind: Callable[[int], bool], forbidden: int) -> str | None:
    if not is_kind(status.st_mode):
        return f"{path} is neither folder nor file"
    if status.st_uid != 0 and not operating_system.is_own(status):
        return f"{path} belongs to user {status.st_uid}"
    if status.st_mode & forbidden:
        return f"{path} can be written by others (mode {stat.S_IMODE(status.st_mode):o})"
    return None


@cache
def find_folder_to_keep_in() -> Path | None:
    """The first place that can be written, made if it does not exist; None where no place can be written."""
    for place in find_places():
        if place.fault is None:
            with contextlib.suppress(OSError), for_owner_to_write():
                place.folder.mkdir(parents=True, exist_ok=True)
                if find_fault(place.folder) is None and os.access(place.folder, os.W_OK | os.X_OK):
                    return place.folder
    return None


def name_of_folder() -> str | None:
    folder = find_folder_to_keep_in()
    return None if folder is None else str(folder)


@contextlib.contextmanager
def for_owner_to_write() -> Iterator[None]:
    """A block in which new files and folders are readable by all users and writable by their owner only.

    All users load the code that an administrator keeps, so they must be able to read it.
    """
    before = os.umask(0o022)
    try:
        yield
    finally:
        os.umask(before)


@cache
def hash_of_sources() -> str:
    """SHA-256 of all sources of this package, as hex digits.

    Compiled code depends on all of them: it holds the functions that it calls and the constants of other files.
    """
    digest = hashlib.sha256()
    for path in sorted(SOURCES.rglob("*.py")):
        digest.update(str(path.relative_to(SOURCES)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def has_whole(what: Whole) -> bool:
    """True where a note says that this process can load all compiled code of ``what``.

    Where some of that code has been removed since, numba compiles it.
    """
    name = name_of_note(what)
    return any(place.fault is None and (place.folder / name).exists() for place in find_places())


@cache
def name_of_note(what: Whole) -> str:
    """Name of the file that notes that all compiled code of ``what`` is kept.

    The name follows from all that the code is made for: the sources, Python, numba, llvmlite and the processor.
    """
    digest = hashlib.sha256(hash_of_sources().encode())
    for text in (sys.version, _version_of("numba"), _version_of("llvmlite"), *_name_processor()):
        digest.update(text.encode() + b"\0")
    return f"{what}-{digest.hexdigest()[:32]}.whole"


def _version_of(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _name_processor() -> Iterator[str]:
    yield platform.machine()
    if (given := os.environ.get("NUMBA_CPU_NAME")) is not None:
        yield given
        return
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if line.startswith(("model name", "flags", "Features", "CPU part")):
                yield line
            if not line.strip():  # the first processor is like the others
                return
