"""Where compiled code is kept, and from where it may be loaded: never from a place that another unprivileged user can
write, as loading it is running it.

Places, in this order: the folder in NUMBA_CACHE_DIR alone, if that is set; else ``__pycache__`` beside this file, which
an administrator may have filled for all users, and ``dsse`` in the cache folder of the user. Code is loaded from the
first that has it and kept in the first that can be written. Where there is none, each process compiles anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache

from dsse_core import compiling
from dsse_core.errors import InvalidInputError

BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH
SOURCES = Path(__file__).resolve().parent
CODE = (".nbi", ".nbc")  # numba's index and data files
not_kept: list[OSError] = []
"""Why code of this process could not be written."""


@dataclass(frozen=True, slots=True)
class Place:
    """A folder for compiled code. ``fault``: why nothing is loaded from it nor kept there, if so."""

    folder: Path
    fault: str | None


@cache
def find_places() -> tuple[Place, ...]:
    """All places that are looked at, in their order.

    Raises:
        InvalidInputError: NUMBA_CACHE_DIR is set to a place that others can write.
    """
    of_sources = f"{SOURCES.name}-{hashlib.sha256(os.fsencode(SOURCES)).hexdigest()[:32]}"  # of one installation
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        folder = Path(given).absolute() / of_sources
        if fault := find_fault(folder):
            cure = "make it writable by its owner only, or choose another folder"
            raise InvalidInputError("NUMBA_CACHE_DIR", [f"compiled code is not loaded from {folder}: {fault}; {cure}"])
        return (Place(folder.resolve(), None),)
    folders = [SOURCES / "__pycache__"]
    with contextlib.suppress(RuntimeError):  # no home
        of_user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folders.append(of_user.absolute() / "dsse" / of_sources)
    return tuple(Place(folder.resolve(), find_fault(folder)) for folder in folders)


def find_fault(folder: Path) -> str | None:
    """Who but root and the user of this process could have put code into ``folder``, in words; None: nobody.

    Looked at are the folder, all folders above it, and the compiled code in it; what does not exist yet is no fault.
    """
    if not hasattr(os, "geteuid"):
        return None  # Windows: permissions are not in these bits, and folders of users are theirs
    folder = folder.resolve()
    try:
        for path in (folder, *folder.parents):
            with contextlib.suppress(FileNotFoundError):
                status = path.lstat()
                sticky_above = (
                    path != folder and status.st_mode & stat.S_ISVTX
                )  # there, nobody renames what is another's
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
    if status.st_uid not in (0, os.geteuid()):
        return f"{path} belongs to user {status.st_uid}"
    if status.st_mode & forbidden:
        return f"{path} can be written by others (mode {stat.S_IMODE(status.st_mode):o})"
    return None


@cache
def find_folder_to_keep_in() -> Path | None:
    """The first place that can be written, made if it is not there; None where there is none."""
    for place in find_places():
        if place.fault is None:
            with contextlib.suppress(OSError), _for_owner_to_write():
                place.folder.mkdir(parents=True, exist_ok=True)
                if find_fault(place.folder) is None and os.access(place.folder, os.W_OK | os.X_OK):
                    return place.folder
    return None


def _name_of_folder() -> str | None:
    folder = find_folder_to_keep_in()
    return None if folder is None else str(folder)


@contextlib.contextmanager
def _for_owner_to_write() -> Iterator[None]:
    """Files and folders are made readable by all, as code that an administrator keeps must be, writable by one."""
    before = os.umask(0o022)
    try:
        yield
    finally:
        os.umask(before)


@cache
def _hash_of_sources() -> str:
    """Of all sources: compiled code holds what it calls and the constants that it uses, from other files, too."""
    digest = hashlib.sha256()
    for path in sorted(SOURCES.rglob("*.py")):
        digest.update(str(path.relative_to(SOURCES)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


class KeptCode:
    """The cache of one compiled function, in place of numba's own, which takes any folder that can be written."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._caches: dict[Path, FunctionCache] = {}
        for folder in (place.folder for place in find_places() if place.fault is None):
            with contextlib.suppress(RuntimeError):  # where NUMBA_CACHE_LOCATOR_CLASSES names others than ours
                kept = _cache_in(folder)(function)
                if isinstance(kept._impl.locator, _Locator):
                    self._caches[folder] = kept

    @property
    def cache_path(self) -> str | None:
        return _name_of_folder()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        for kept in self._caches.values():
            with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError):  # unreadable or broken: compile anew
                if (code := kept.load_overload(sig, target_context)) is not None:
                    return code
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        folder = find_folder_to_keep_in()
        if folder is not None and folder in self._caches:
            try:
                with _for_owner_to_write():
                    self._caches[folder].save_overload(sig, data)
            except OSError as error:  # a full disk: the next process compiles anew
                not_kept.append(error)

    def enable(self) -> None: ...

    def disable(self) -> None: ...

    def flush(self) -> None: ...


class _Locator:
    """What numba asks where a function's code is kept, and whether it is still that of its source."""

    def __init__(self, line: int, file: str) -> None:
        self._py_file, self._line = file, line

    def ensure_cache_path(self) -> None: ...

    def get_source_stamp(self) -> str:
        return _hash_of_sources()

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Locator:
        return cls(function.__code__.co_firstlineno, file)


@cache
def _cache_in(folder: Path) -> type[FunctionCache]:
    class Locator(_Locator):
        def get_cache_path(self) -> str:
            return str(folder)

    class Implementation(CompileResultCacheImpl):
        _locator_classes = [Locator]  # noqa: RUF012

    class Cache(FunctionCache):
        _impl_class = Implementation

    return Cache


class _Listener(event.Listener):
    """Tells when functions of ours are compiled, those that they call included: the outermost begins and ends."""

    depth = 0

    def on_start(self, begun: Any) -> None:
        if _is_ours(begun):
            self.depth += 1
            if self.depth == 1:
                compiling.note(True, _name_of_folder())

    def on_end(self, ended: Any) -> None:
        if _is_ours(ended):
            self.depth -= 1
            if self.depth == 0:
                compiling.note(False, None)


def _is_ours(of: Any) -> bool:
    return bool(of.data["dispatcher"].py_func.__module__.startswith(f"{__package__}."))


event.register("numba:compile", _Listener())
